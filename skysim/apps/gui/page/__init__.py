"""The page of a browser tab: its head, its keys and list of actions, its history in the browser, its arrangement."""
