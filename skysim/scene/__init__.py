"""The schema of a scene: a YAML file becomes a validated, frozen `Scene`. No physics."""
