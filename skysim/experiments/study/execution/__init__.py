"""Execution of a study's trials in this process, a process pool or a Dask cluster; their store; replay of one."""
