"""User-facing programs: command line, browser GUI, real-time stream and plate solver."""
