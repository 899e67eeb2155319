"""The air over a site: refraction, extinction, scintillation and the horizon."""
