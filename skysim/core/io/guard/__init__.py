"""Untrusted files are read in a child process with limits: libraries written in C may crash, hang or fill memory."""
