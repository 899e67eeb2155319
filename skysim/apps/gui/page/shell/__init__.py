"""What surrounds the panels of a page: its history in the browser, the list of its actions, its arrangement."""
