"""Devices on another machine: mirrors of cells, and contact proxies."""
