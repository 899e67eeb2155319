"""What every part of a page uses: its state, live fields, keys, the forms of a scene's keys, colors and wording."""
