"""Many logs evaluated in parallel, on one machine or on Ray: one row each, in one Parquet file."""
