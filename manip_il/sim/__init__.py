"""Robots, tasks and physics: MjSpec in, a gymnasium environment out."""
