"""The detector: fixed pattern, noise, charge transfer and cosmic rays, one function per step."""
