"""Compare variants, captures or runs: tables, pictures and the page of results."""
