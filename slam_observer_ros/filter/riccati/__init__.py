"""The Riccati filter: gains from the full covariance."""
