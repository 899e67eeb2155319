"""The settings of a scene as forms: all its keys, and those of sensor and identifier."""
