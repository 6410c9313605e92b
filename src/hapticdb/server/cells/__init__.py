"""The endpoint `/device/cells`: rows and objects for clients that compute their own forces."""
