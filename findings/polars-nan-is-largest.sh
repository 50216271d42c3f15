#!/usr/bin/env bash
# A Parquet table of frames has a PSNR of NaN for a frame that could not be measured. Frames above 30 dB are chosen.
# Guess: NaN > 30 is false, as in NumPy, so that frame is left out by every reader.
# Seen: polars keeps it, because it counts NaN as the largest number; pandas and pyarrow leave it out. A missing value (null) is
# left out by all three, and only with null are the means equal.
# Exit: 0 as described, 1 changed, 2 cannot be tried here.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cannot() {
  echo "cannot be tried here: $1"
  exit 2
}
cd "$work"
python3 -m venv env || cannot "python3 with its module venv is missing"
env/bin/python -m pip install --quiet --disable-pip-version-check polars==2.1.0 pandas==3.1.1 pyarrow==26.0.1 numpy==2.4.6 ||
  cannot "the packages could not be installed"
env/bin/python - <<'EOF'
import sys

import numpy as np
import pandas
import polars
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

print("polars", polars.__version__, "pandas", pandas.__version__, "pyarrow", pa.__version__)
seen = {}
for name, unmeasured in (("NaN", np.nan), ("null", None)):
    pq.write_table(pa.table({"frame": [0, 1, 2], "psnr": pa.array([31.0, unmeasured, 25.0])}), "frames.parquet")
    by_polars = polars.read_parquet("frames.parquet")
    by_pandas = pandas.read_parquet("frames.parquet")
    by_arrow = pq.read_table("frames.parquet", filters=[("psnr", ">", 30)])
    seen[name] = {
        "polars": by_polars.filter(polars.col("psnr") > 30)["frame"].to_list(),
        "pandas": by_pandas[by_pandas.psnr > 30].frame.tolist(),
        "pyarrow": by_arrow["frame"].to_pylist(),
    }
    means = by_polars["psnr"].mean(), float(by_pandas.psnr.mean()), pc.mean(pq.read_table("frames.parquet")["psnr"]).as_py()
    print(f"{name}: frames above 30 dB {seen[name]}, means {means}")
print("guess: frame 0 in all cases")
as_described = seen["null"] == {"polars": [0], "pandas": [0], "pyarrow": [0]} and seen["NaN"]["polars"] == [0, 1] and (
    seen["NaN"]["pandas"] == seen["NaN"]["pyarrow"] == [0]
)
print("as described" if as_described else "CHANGED")
sys.exit(not as_described)
EOF
