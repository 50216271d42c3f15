"""Settings for all tests."""

import os

from hypothesis import HealthCheck, settings

# A busy machine is no failure: examples have no deadline, and drawing them may be slow.
settings.register_profile("cleargs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("cleargs")

# As the program does (`cleargs.cli.entry`): tests that run beside each other have more threads than cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
