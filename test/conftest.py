"""Settings for all tests."""

from hypothesis import settings

# No deadline: no test may depend on how busy the machine is.
settings.register_profile('suite', deadline=None, max_examples=25)
settings.load_profile('suite')
