"""External star trackers: the interface, the process that runs one, and the plug-in for tetra3rs."""
