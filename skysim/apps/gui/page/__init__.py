"""The page in the browser: layout, 3-D view, overlay, forms, keyboard map and panels."""
