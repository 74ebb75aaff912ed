"""An excitation with structure: a running estimator, a speed loop, and a reference that may depend on the estimate.

What is learned or optimised is the reference alone, a handful of numbers. The scalar functions run as plain Python or
compiled; :class:`emb_train.structured.actor.StructuredActor` computes the same as one torch module.
"""
