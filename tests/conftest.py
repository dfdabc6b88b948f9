"""For all tests: hypothesis draws its examples, and judges nobody by the clock."""

from hypothesis import settings

settings.register_profile("asc", deadline=None)  # the machines are shared: a slow example is no fault
settings.load_profile("asc")
