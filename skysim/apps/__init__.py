"""What people start: the command line, the page in the browser, the real-time stream and the plate solver."""
