"""The verbs, none of which knows another, in the order of the work:

detect, match, triangulate, weigh, predict, identify, orient, verify, update, tend.
"""
