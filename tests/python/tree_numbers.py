"""What pages tell of a branch, counted again: length, least and mean diameter, diameter at a point and way to it, mm."""
import re

import numpy as np


def measure(branch, point):
    points, wide = np.array(branch["points_mm"]), 2 * np.array(branch["radius_mm"])
    along = np.concatenate([[0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    return [along[-1], wide.min(), np.trapezoid(wide, along) / along[-1], wide[point], along[point]]


def numbers_of(told):
    return [float(number) for number in re.findall(r"([0-9.]+) mm", told)][:5]


def doubt_of(told):
    """The interval, mm, and the probability of existence, percent."""
    return [float(number) for number in re.search(r"known to ([0-9.]+) mm \(68 %\), exists with ([0-9]+) %", told).groups()]
