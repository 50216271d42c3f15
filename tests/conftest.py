"""Settings for all tests."""

from hypothesis import HealthCheck, settings

# A busy machine is no failure: examples have no deadline, and drawing them may be slow.
settings.register_profile("cleargs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("cleargs")
