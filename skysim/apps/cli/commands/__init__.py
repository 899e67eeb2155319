"""The commands of `skysim`, one file per topic. They parse options, call the library and print its results."""
