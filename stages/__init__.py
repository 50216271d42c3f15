"""The five stages, in order. The runner loads ``cleargs.stages.<name>`` by name; each module fulfils
`cleargs.pipeline.stage.Stage`."""

STAGES = ("ingest", "rva", "g0", "rivr", "consolidate")
