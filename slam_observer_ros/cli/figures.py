"""The figures of a run that people compare, by their names in JSON."""

from __future__ import annotations

import math

from slam_observer_ros.common.digits import significant

ACCURACY_ROWS = {
    'ate_rmse_m': ('position error (ATE), RMS', 'm after alignment'),
    'dead_reckoning_ate_rmse_m': ('of the velocities alone', 'm after alignment'),
    'unaligned_rmse_m': ('position error, not aligned', "m if the truth is in the map's frame"),
    'heading_rmse_rad': ('heading error, RMS', '° after alignment'),
    'landmark_rmse_m': ('landmark error, RMS', 'm after alignment'),
    'configuration_rmse_m': ('configuration error, RMS', 'm, not aligned'),
    'anees': ('ANEES of the pose', '(1 is consistent)'),
    'configuration_anees': ('ANEES of the configuration', '(1 is consistent)'),
    'unsmoothed_ate_rmse_m': ('of the part that is smoothed, online', 'm after alignment'),
    'smoothed_ate_rmse_m': ('smoothed: position error, RMS', 'm after alignment'),
    'smoothed_landmark_rmse_m': ('smoothed: landmark error, RMS', 'm after alignment'),
}
"""Figures of ``--json`` that are in the table, their names there and their units."""

TRAJECTORY_ROWS = {
    'poses_compared': ('poses compared', ''),
    'time_compared': ('share of the time', '%'),
    'ate_max_m': ('position error, maximum', 'm'),
    'ate_median_m': ('position error, median', 'm'),
    'ate_std_m': ('position error, std. deviation', 'm'),
    'drift': ('drift of the position', '%'),
    'drift_rad_per_m': ('drift of the attitude', '°/m'),
    'path_length_m': ('path length', 'm'),
    'true_path_length_m': ('path length of the truth', 'm'),
}
"""Further figures of a trajectory beside others."""

FIGURES = (*ACCURACY_ROWS, 'nis', 'seconds')
"""What runs are compared by."""


def figure_text(key: str, figure: float, unit: str) -> str:
    """Return a figure as people read it: angles in degrees."""
    return f'{number_text(key, figure)} {unit}'


def number_text(key: str, figure: float) -> str:
    """Return the number in the unit that people read: degrees, and shares in per cent."""
    if isinstance(figure, int):
        return str(figure)
    if key.endswith(('_rad', '_rad_per_m')):
        return significant(math.degrees(figure))
    return significant(100.0 * figure if key in ('drift', 'time_compared') else figure)
