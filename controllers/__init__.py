"""Hover controllers for CoaxHeli-v0: designed, trained, and measured alike."""

from controllers.loading import Controller, load_controller

__all__ = ["Controller", "load_controller"]
