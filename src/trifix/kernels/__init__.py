"""The compiled inner loops.

Each module stands alone: a cached kernel does not notice that a kernel in another file has changed.
"""
