"""The shield's argument, checked by machine: for every brake of the set and every state, not for samples of them.

The shield's own functions are run on values that stand for many numbers at once: exact real numbers in an SMT solver
(:mod:`~proof.terms`) and intervals with outward rounding (:mod:`~proof.intervals`), both with every branch that they
can take (:mod:`~proof.symbolic_execution`). ``python -m proof`` prints the lemmas.
"""
