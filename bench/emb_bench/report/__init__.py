"""Reports on runs as text, tables, figures and one HTML page: the excitation, the estimate and its uncertainty."""
