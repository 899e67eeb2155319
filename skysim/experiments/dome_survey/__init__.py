"""Survey of an LED dome with the vehicle's own camera: plan, frames, identification, adjustment, faults, report."""
