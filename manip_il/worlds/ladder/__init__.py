"""Our own worlds: a robot by its YAML at a task of its own file, and the expert that climbs the
task's ladder.
"""
