"""Commands that measure a dome, a camera, a vehicle or a tracker."""
