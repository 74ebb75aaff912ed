"""One page about one or several runs, to be handed over: what was done, what is known afterwards, and what is not."""
