"""Variants of the benchmark's worlds, and the columns that their tables have."""

from __future__ import annotations

from estimators import EKF, ISAM2_DEFAULT

from slam_observer_ros.estimator.placement import DESIGNS

CLEAN, OUTLIERS, LEFT_OUT, NO_IDS = 'accuracy', 'with_outliers', 'left_out', 'without_ids'
FALSE_POINTS = 'false_points'
VARIANTS = (CLEAN, OUTLIERS, LEFT_OUT, NO_IDS, FALSE_POINTS)
OUTLIER_COLUMNS = (*DESIGNS, EKF, ISAM2_DEFAULT)

WORST = ', worst draw'
"""Ending of the columns that have the worst of several sets of outliers."""
