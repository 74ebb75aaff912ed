"""``emb-train reproduce``: the thesis's trainings, tables and figures anew, and what it prints beside what came out."""
