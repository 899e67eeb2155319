"""Star trackers of other people: the interface, the process that runs one, and the adapter of tetra3rs."""
