"""A GPU that is only pretended: tensors of the device "cuda" that the CPU computes.

It is for machines that have none. The code of a GPU runs there with real numbers, and what a GPU would refuse is refused: tensors of two
devices in one operation, an array that looks at a GPU's memory. Waits for the device are counted, and copies to it that wait. What a
real one alone can show: its memory, speed and rounding, streams, and compiled code.
"""
