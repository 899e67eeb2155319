"""A lens from frames of the night sky: image size over the field, and focal length and distortion."""
