"""The shell of the dome: its inner surface, measured or ideal, and the room that it must fit into."""
