"""Records: structured dtypes for state shared by Python, kernels and processes.

A kernel takes an array of records of 0 axes or 1 and reads ``record = array[()]`` once. A field is
then a constant offset, as cheap as an element of a vector. Passing one record to a kernel costs 0.4
us, and every further array 0.2 us (a NamedTuple costs that for each of its arrays), so related
numbers form one record.

In Python, ``array["hits"]`` is a view of a field; a loop at 1 kHz makes its views once, with
`layout.views_of`. This folder imports numpy alone, so a layout is available without numba.
"""
