"""Settings for every test."""

from hypothesis import HealthCheck, settings

# How long an example takes says something about the machine, nothing about the program.
settings.register_profile("manip_il", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("manip_il")
