"""The steps of a run: functions that take inputs and a run, write its files, and return the
result.
"""
