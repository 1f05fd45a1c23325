"""What every part of the package uses: errors, array types, time, files."""

__version__ = '0.1.0'
