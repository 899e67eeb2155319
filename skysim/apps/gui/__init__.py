"""The lab in the browser: a page over simulate and study.

    page (what is shown) ── session (a tab's worker process) ── desk (the lab that the worker has before it)

The event loop does no work: frames are made, solved and flown in the tab's own process, studies in a process of theirs.
"""
