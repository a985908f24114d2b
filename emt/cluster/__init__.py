"""Several processes or machines through Dask: the client packs and stores, workers build, compile and compute.

`parcel` is what travels, `tasks` what runs on a worker; `pool` hands out tasks, `connecting` makes a pool, and `source`
is where the runner gets its chunks from. Only a pool needs the optional package `distributed`.
"""
