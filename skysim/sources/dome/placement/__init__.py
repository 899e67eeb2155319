"""LED placement: Fisher information of the attitude, ambiguity between fields of view, and the search for the best
layout.
"""
