"""The schema of a scene: a YAML file becomes a validated, frozen `Scene`. No physics."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "loader": ["list_scenes", "load", "load_scene"],
        "scene": ["Scene"],
    },
)
