"""Warnings about configurations."""


class ConfigWarning(UserWarning):
    """Something in a configuration that can be used but is probably not meant."""
