"""The `preference` reward model as a LeRobot plugin: importing `configuration_preference` registers it."""
