"""LED placement: Fisher information of the attitude, ambiguity between fields, and the search for the best layout."""
