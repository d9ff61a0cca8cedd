"""Fits of tracks and speeds at once, with what is not known beside the parameters of the robot.

A source makes a gait (how the robot swims) or a track of the parameters, maps make of it what a
camera sees, and everything that is not known is a parameter with a prior.
"""
