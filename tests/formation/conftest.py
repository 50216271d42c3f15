"""The back end of a test."""

from helpers.devices import device as device
