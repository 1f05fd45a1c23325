"""Small files of the public data sets' formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy.io


def write_mrclam(folder: Path) -> Path:
    """Make a run of robot 2: commands, one landmark seen with a robot, a misread, another one."""
    folder.mkdir()
    files = {
        'Barcodes.dat': [(1, 5), (2, 14), (6, 63), (7, 81)],
        'Landmark_Groundtruth.dat': [(6, 1.0, 2.0, 0.0, 0.0), (7, 3.0, 4.0, 0.0, 0.0)],
        'Robot2_Groundtruth.dat': [(1248444187.156, 1.0, 2.0, np.pi / 2)],
        'Robot2_Odometry.dat': [(1248444187.156, 0.5, -0.25), (1248444187.166, 0.5, 0.0)],
        'Robot2_Measurement.dat': [
            (1248444187.157, 63, 2.0, np.pi / 2),
            (1248444187.157, 5, 1.0, 0.0),
            (1248444187.157, 81, 3.0, 0.0),
            (1248444187.158, 99, 1.0, 0.0),
            (1248444187.159, 81, 4.0, 0.0),
        ],
    }
    for name, rows in files.items():
        lines = ['# a header', *(' \t '.join(map(repr, map(float, row))) for row in rows)]
        (folder / name).write_text('\n'.join(lines))
    return folder


def write_plaza(folder: Path, turned: float = 0.0) -> Path:
    """Make run 1, 0.5 m ahead and then to the left, whose truth has the yaw ``turned`` by so much.

    A stamp comes twice, and of three distances one is none.
    """
    folder.mkdir(exist_ok=True)
    yaws = [turned, turned, np.pi / 2 + turned]
    tables = {
        'dr': ('t,forward_m,turn_rad', [(10, 0, 0), (10.5, 0.5, 0.25), (10.5, 0, 0), (11, 1, 0)]),
        'gt': ('t,x,y,yaw', [(10, 0, 0, yaws[0]), (10.5, 0.5, 0, yaws[1]), (11, 1, 1, yaws[2])]),
        'td': ('t,sender,anchor,range_m', [(10.9, 2, 5, 4), (10.1, 2, 1, 3), (10.2, 2, 1, 0)]),
        'tl': ('anchor,x,y', [(1, 3, 0), (5, 1, 5)]),
    }
    for name, (head, rows) in tables.items():
        lines = [head, *(','.join(f'{number:.6f}' for number in row) for row in rows)]
        (folder / f'plaza1_{name}.csv').write_text('\n'.join(lines))
    return folder


def write_starry_night(file: Path, **changes: np.ndarray) -> Path:
    """Make two frames of a stereo camera that looks along x; landmark 4 seen in the second."""
    pixels = np.full((4, 2, 20), -1.0)
    # 2 m ahead, 1 m to the left, 0.5 m up, with focal length 100 and a baseline of 0.5 m.
    pixels[:, 1, 4] = [320.0 - 50, 240 - 25, 320 - 75, 240 - 25]
    camera_axes = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    variables = {
        't': np.array([[0.0, 0.25]]),
        'v_vk_vk_i': np.array([[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]),
        'w_vk_vk_i': np.array([[0.1, 0.4], [0.2, 0.5], [0.3, 0.6]]),
        'y_k_j': pixels,
        'r_i_vk_i': np.ones((3, 2)),
        'theta_vk_i': np.array([[0.0, 0.0], [0.0, 0.0], [0.0, np.pi / 2]]),
        'rho_i_pj_i': np.arange(60.0).reshape(3, 20),
        'C_c_v': camera_axes,
        'rho_v_c_v': np.array([[0.1], [0.0], [0.0]]),
        'fu': 100.0,
        'fv': 100.0,
        'cu': 320.0,
        'cv': 240.0,
        'b': 0.5,
    }
    scipy.io.savemat(file, variables | changes)
    return file
