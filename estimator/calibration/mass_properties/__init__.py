"""Mass properties of a vehicle on an air bearing from star-tracker attitudes: inertia tensor and center of mass."""
