# SPDX-License-Identifier: Apache-2.0

"""A stand-in for a tensor of PyTorch, which refuses numpy what PyTorch refuses."""

import numpy as np


class Tensor:
    """Has values and a shape; it may have a gradient, be on a GPU, or have numbers of 16 bits."""

    def __init__(self, values, *, gradient=False, on_gpu=False, is_bfloat16=False):
        self._values = np.asarray(values)
        self._kind = {"gradient": gradient, "on_gpu": on_gpu, "is_bfloat16": is_bfloat16}

    @property
    def shape(self):
        return self._values.shape

    def _with(self, **kind):
        return Tensor(self._values, **{**self._kind, **kind})

    def detach(self):
        return self._with(gradient=False)

    def cpu(self):
        return self._with(on_gpu=False)

    def float(self):
        return self._with(is_bfloat16=False)

    def clone(self):
        return Tensor(self._values.copy(), **self._kind)

    def item(self):
        return self._values.item()

    def numpy(self):
        if self._kind["gradient"]:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")
        if self._kind["on_gpu"] or self._kind["is_bfloat16"]:
            raise TypeError("can't convert it: Got unsupported ScalarType BFloat16")
        return self._values

    def __array__(self, dtype=None, copy=None):
        return self.numpy().astype(dtype or self._values.dtype)

    def __len__(self):
        return len(self._values)

    def __getitem__(self, place):
        return Tensor(self._values[place], **self._kind)

    def __deepcopy__(self, memo):
        if self._kind["gradient"]:
            raise RuntimeError("Only Tensors created explicitly by the user support deepcopy")
        return self.clone()


KINDS = [
    {},
    {"gradient": True},
    {"is_bfloat16": True},
    {"gradient": True, "on_gpu": True, "is_bfloat16": True},
]
