"""What the builder of a dome needs: patterns, a mesh, the list of parts and their prices."""
