"""Values as a scene file states them: with a unit, with a tolerance, as a date."""
