"""Which frames calibrate INT8, and the ranges that they show."""
