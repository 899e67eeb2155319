"""Code that users bring, as a package's entry point or as a program behind a pipe: star trackers and controllers."""
