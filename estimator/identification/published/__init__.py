"""Published star identification algorithms: pyramid, SAA, SHEFEX-2, PTASE and the master star."""
