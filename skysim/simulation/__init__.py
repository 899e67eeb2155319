"""Run a scene: build the lab, fly it, expose the frames, close the loop.

`lab` is what is there, `flight` moves it and yields the exposures, `checks` forecasts them.
"""
