"""Finds the folder above, whose worlds and estimators the studies use, when one of them runs."""

from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
