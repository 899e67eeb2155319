"""Browser GUI: an interactive front end for the simulation and for studies.

    page (browser elements) ── worker.session (a worker process per tab) ── worker.workbench (the worker's scene)

Imports run one way: server > page > views > worker > messages. A panel or a view knows the page as a
`views.context.PageContext`.

The server's event loop does no heavy work. Each tab has a worker process that renders and solves frames and simulates
the motion; a study runs in a further process (worker.study_process).
"""
