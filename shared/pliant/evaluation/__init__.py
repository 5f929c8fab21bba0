"""Accuracy of a result: trajectories, tracks and maps compared with ground truth, and the
reports.
"""
