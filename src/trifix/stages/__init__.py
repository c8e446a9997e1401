"""The verbs, none of which knows another, in the order of the work:

detect, match, triangulate, identify, orient, verify, update.
"""
