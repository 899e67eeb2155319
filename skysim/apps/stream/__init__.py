"""A scene sent out as it happens, at the pace of real time: for trackers that run on other programs or processors."""
