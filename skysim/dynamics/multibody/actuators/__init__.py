"""Actuators: each kind in a file of its own, from the joints of the model to the command law; `registry` has all."""
