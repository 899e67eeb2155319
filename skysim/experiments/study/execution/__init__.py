"""Who does a study's trials: this process, a pool of processes or a Dask cluster; and replaying one trial."""
