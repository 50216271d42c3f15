"""Variants, captures or runs side by side: tables, pictures and the page of results."""
