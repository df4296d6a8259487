"""Ye & Yang 2017 run again: their systems, their experiment, and what holds over seeds."""
