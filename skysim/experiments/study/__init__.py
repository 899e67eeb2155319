"""Studies: many trials of a scene whose fields vary, answered with error bars.

A study file becomes a `plan`; `trials` does one; an engine of `engines` does them all; `store` keeps a row of each;
`table` says what came of it, `page` shows it.
"""
