"""What the browser shows: page, 3-D view, overlay, forms, keys and panels."""
