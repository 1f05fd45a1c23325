"""What every part of the package uses: errors, array types, time, files."""
