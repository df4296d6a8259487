"""From a CasADi function to vectorised NumPy: the same operations, in the same order, on arrays of
stars.

CasADi evaluates one star at a time; walking its instruction list once and emitting every
instruction as a NumPy operation gives kernels that need no compiler and agree with CasADi to
rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from starcal_uq.core.types import AnyDict, FloatArray, floats

# Stars are evaluated in blocks whose temporaries stay in the processor's second-level cache.
BLOCK = 6144

_UNARY = {
    "OP_ASSIGN": "{0}",
    "OP_NEG": "-{0}",
    "OP_SQ": "{0} * {0}",
    "OP_TWICE": "{0} + {0}",
    "OP_INV": "1.0 / {0}",
    "OP_SQRT": "np.sqrt({0})",
    "OP_SIN": "np.sin({0})",
    "OP_COS": "np.cos({0})",
    "OP_TAN": "np.tan({0})",
    "OP_ATAN": "np.arctan({0})",
    "OP_EXP": "np.exp({0})",
    "OP_LOG": "np.log({0})",
    "OP_FABS": "np.abs({0})",
}
_BINARY = {
    "OP_ADD": "{0} + {1}",
    "OP_SUB": "{0} - {1}",
    "OP_MUL": "{0} * {1}",
    "OP_DIV": "{0} / {1}",
    "OP_POW": "{0} ** {1}",
    "OP_CONSTPOW": "{0} ** {1}",
    "OP_ATAN2": "np.arctan2({0}, {1})",
    "OP_HYPOT": "np.hypot({0}, {1})",
}


def emit_source(function: Any, name: str) -> str:
    """Write the instruction list of a dense CasADi SX function as Python source, ``def name(inputs,
    out)``.

    `inputs` is a sequence (one entry per input) of sequences of scalars or (n,) arrays, one per
    element; `out` is a sequence of (n_elements, n) arrays, one per output, which are filled.
    NotImplementedError for an operation without a NumPy counterpart in this module.
    """
    import casadi as ca

    templates = {getattr(ca, key): value for key, value in (_UNARY | _BINARY).items()}
    lines = [f"def {name}(inputs, out):"]
    for index in range(function.n_instructions()):
        operation = function.instruction_id(index)
        sources = function.instruction_input(index)
        targets = function.instruction_output(index)
        if operation == ca.OP_CONST:
            lines.append(f"    w{targets[0]} = {float(function.instruction_constant(index))!r}")
        elif operation == ca.OP_INPUT:
            lines.append(f"    w{targets[0]} = inputs[{sources[0]}][{sources[1]}]")
        elif operation == ca.OP_OUTPUT:
            lines.append(f"    out[{targets[0]}][{targets[1]}] = w{sources[0]}")
        elif operation in templates:
            expression = templates[operation].format(*(f"w{source}" for source in sources))
            lines.append(f"    w{targets[0]} = {expression}")
        else:
            raise NotImplementedError(
                f"CasADi operation {operation} has no NumPy template in kernels.py"
            )
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Kernel:
    """A vectorised function generated from CasADi.

    `function` is the symbolic original, kept so that tests can compare, `run` the emitted NumPy
    function, and `shapes` those of the outputs, without the trailing axis of stars.
    """

    function: Any
    run: Callable[[Sequence[Any], Sequence[Any]], None]
    shapes: tuple[tuple[int, ...], ...]

    def __call__(self, n: int, *inputs: Any) -> tuple[FloatArray, ...]:
        """Outputs ``(*shape, n)`` for `n` stars; inputs (elements,) are shared by all, others are
        (elements, n).
        """
        outputs = [np.empty((int(np.prod(shape)), n)) for shape in self.shapes]
        arrays = [floats(value) for value in inputs]
        # Python floats keep the arithmetic of shared scalars cheap.
        shared = [value.tolist() if value.ndim == 1 else None for value in arrays]
        for start in range(0, n, BLOCK):
            block = slice(start, min(start + BLOCK, n))
            self.run(
                [
                    value[:, block] if scalars is None else scalars
                    for value, scalars in zip(arrays, shared, strict=True)
                ],
                [output[:, block] for output in outputs],
            )
        return tuple(
            output.reshape(*shape, n) for output, shape in zip(outputs, self.shapes, strict=True)
        )

    def into(self, inputs: Sequence[FloatArray], outputs: Sequence[FloatArray]) -> None:
        """Evaluate stars whose arrays fit into the cache, into arrays (elements, n) that the caller
        keeps.
        """
        self.run([value.tolist() if value.ndim == 1 else value for value in inputs], outputs)


def build_kernel(
    name: str, inputs: Sequence[Any], outputs: Sequence[Any], shapes: Sequence[tuple[int, ...]]
) -> Kernel:
    """Build a kernel from CasADi symbols and expressions; elements of an output lie row-major over
    its shape.
    """
    import casadi as ca

    name = name.replace("+", "_")
    function = ca.Function(
        name, list(inputs), [ca.densify(ca.vec(ca.SX(output))) for output in outputs], {"cse": True}
    )
    scope: AnyDict = {"np": np}
    # The source is generated from CasADi's instruction list above and holds nothing from outside.
    exec(compile(emit_source(function, name), f"<kernel {name}>", "exec"), scope)
    return Kernel(function=function, run=scope[name], shapes=tuple(shapes))
