"""Reading of log files, cut and damaged ones included, down to records, topics and columns."""
