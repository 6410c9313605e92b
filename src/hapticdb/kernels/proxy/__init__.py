"""Kernels of contact proxies: a model of the contacts around one pose, and its evaluation."""

from hapticdb.kernels._later import later_modules

__getattr__ = later_modules(__name__, __file__)
