"""Many scenes at once: the sheet that lists them, what each job does, Snakemake as the engine that runs them.

`cleargs stage` stays the owner of the work and of the store. Snakemake only decides when each of them starts;
it lives in an environment of its own and is never imported here.
"""
