"""Run a scene: build the lab, fly it, expose the frames, close the loop.

`lab` holds the hardware, `flight` moves it and yields the exposures, `checks` predicts them.
"""
