"""Execution of a study's trials: in this process, a process pool or a Dask cluster; replay of one trial."""
