"""The set of brakes and states that the samples leave possible, and the shield's law for it."""
