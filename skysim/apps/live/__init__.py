"""A scene in real time, for flight software, trackers and cameras' clients in other programs or on other processors."""
