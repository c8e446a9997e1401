"""The paper's experiments, repeated on simulated recordings of its scenes (Khoury 2006, sections 3 and 4).

``paper`` runs every technique on every scene, ``measuring`` is one technique on one scene, ``figures`` and ``page``
show what came out. Nothing here judges a frame or counts a rate: that is the positioner's and the evaluation's.
"""
