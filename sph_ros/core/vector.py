# SPDX-License-Identifier: Apache-2.0
"""Vectors of sixteen numbers as values in compiled functions.

What is summed over neighbours is summed for sixteen particles at once, one in each lane. LLVM does
not find such code by itself, so it is written down: numbers of type `Floats` and `Whole` add and
multiply like any others, and `load`, `gather`, `store` move them. On processors without AVX-512
LLVM makes several narrower instructions of each. Interpreted, vectors are numpy arrays.

Here are the types and what is computed with them; `core.vector_memory` reads and writes them.
"""

import operator
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16

#: Numba is told to interpret.
INTERPRETED = bool(config.DISABLE_JIT)

#: Whether the processor has AVX-512: compressing stores, gathering, estimates of 1 / root.
HAS_AVX512 = bool(llvm.get_host_cpu_features().get("avx512f", False))

#: Where the kernel says what was done against a leak of data through gathers (Intel's Downfall).
GATHER_LEAK = Path("/sys/devices/system/cpu/vulnerabilities/gather_data_sampling")


def _gathers_quickly():
    """Whether the processor's own gathers beat sixteen loads.

    They do on Intel's with AVX-512, unless microcode slows them down against a leak. On AMD's Zen 4
    and 5 they take up to a third longer.
    """
    try:
        slowed = GATHER_LEAK.read_text(encoding="ascii").startswith("Mitigation")
    except OSError:
        slowed = False
    return HAS_AVX512 and not slowed and not llvm.get_host_cpu_name().startswith("znver")


#: Whether to gather by the processor's own instructions.
GATHERS = _gathers_quickly()

#: Where the kernel says how large the last cache is before memory.
CACHE_SIZE = Path("/sys/devices/system/cpu/cpu0/cache/index3/size")


def _last_cache():
    """Bytes of the last cache; a usual size where the kernel does not say."""
    try:
        return 1024 * int(CACHE_SIZE.read_text(encoding="ascii").strip().removesuffix("K"))
    except (OSError, ValueError):
        return 1 << 25


#: [bytes]
LAST_CACHE = _last_cache()

#: The same freedom as all other code has: see `core.jit`.
FAST = ("reassoc", "contract", "nsz")

#: Types of LLVM's.
INT16, INT32, INT64, FLOAT = ir.IntType(16), ir.IntType(32), ir.IntType(64), ir.FloatType()
FLOATS, WHOLE = ir.VectorType(FLOAT, LANES), ir.VectorType(INT32, LANES)
BITS = ir.VectorType(ir.IntType(1), LANES)


# ---------------------------------------------------------------- types and their arithmetic


class Floats(types.Type):
    """Sixteen float32."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Floats")


class Whole(types.Type):
    """Sixteen int32."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Whole")


class Truths(types.Type):
    """Sixteen answers to a comparison."""

    def __init__(self):
        """There is one such type."""
        super().__init__(name="Truths")


floats, whole, truths = Floats(), Whole(), Truths()


def _register(kind, backing):
    @register_model(kind)
    class Model(models.PrimitiveModel):
        def __init__(self, manager, numba_type):
            super().__init__(manager, numba_type, backing)


for _kind, _backing in ((Floats, FLOATS), (Whole, WHOLE), (Truths, BITS)):
    _register(_kind, _backing)


def constant(value, kind=FLOATS):
    """A vector with the number `value` in every lane."""
    return ir.Constant(kind, [value] * LANES)


def splat(builder, value):
    """A vector with a number in every lane; vectors stay what they are."""
    if isinstance(value.type, ir.VectorType):
        return value
    vector = ir.VectorType(value.type, LANES)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(INT32, 0))
    return builder.shuffle_vector(first, first, constant(0, WHOLE))


def _define(function, kinds, result, make):
    """Let `function` of values of numba types `kinds` be what `make(builder, *vectors)` returns."""

    @lower_builtin(function, *kinds)
    def lower(context, builder, sig, args):
        values = [
            context.cast(builder, value, given, types.int32)
            if isinstance(given, types.Integer)
            else value
            for given, value in zip(sig.args, args, strict=True)
        ]
        return make(builder, *(splat(builder, value) for value in values))

    return signature(result, *kinds)


def _register_operator(function, pairs, result, make):
    cases_ = [_define(function, kinds, result, make) for kinds in pairs]

    @infer_global(function)
    class Operator(ConcreteTemplate):
        cases = cases_


_WITH_FLOATS = [(floats, floats), (floats, types.float32), (types.float32, floats)]
_WITH_WHOLE = [(whole, whole), (whole, types.int64)]

for _function, _name in (
    (operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"),
    (operator.iadd, "fadd"), (operator.isub, "fsub"), (operator.imul, "fmul"),
):  # fmt: skip
    _register_operator(
        _function, _WITH_FLOATS, floats,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b, flags=FAST),
    )  # fmt: skip
_register_operator(operator.truediv, _WITH_FLOATS, floats, lambda builder, a, b: builder.fdiv(a, b))
for _function, _name in (
    (operator.add, "add"), (operator.sub, "sub"), (operator.mul, "mul"), (operator.and_, "and_"),
    (operator.or_, "or_"), (operator.lshift, "shl"), (operator.rshift, "ashr"),
):  # fmt: skip
    _register_operator(
        _function, _WITH_WHOLE, whole,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b),
    )  # fmt: skip
for _function, _sign in ((operator.lt, "<"), (operator.gt, ">")):
    _register_operator(
        _function, _WITH_FLOATS, truths,
        lambda builder, a, b, sign=_sign: builder.fcmp_ordered(sign, a, b),
    )  # fmt: skip
    _register_operator(
        _function, _WITH_WHOLE, truths,
        lambda builder, a, b, sign=_sign: builder.icmp_signed(sign, a, b),
    )  # fmt: skip
for _function, _name in ((operator.or_, "or_"), (operator.and_, "and_")):
    _register_operator(
        _function, [(truths, truths)], truths,
        lambda builder, a, b, name=_name: getattr(builder, name)(a, b),
    )  # fmt: skip


def _operation(kinds, result, make, plainly):
    """A function of vectors; see `_define`. Interpreted it is `plainly`."""
    if INTERPRETED:
        return plainly

    @intrinsic
    def one(typingctx, a):
        return signature(result, *kinds), generate

    @intrinsic
    def two(typingctx, a, b):
        return signature(result, *kinds), generate

    @intrinsic
    def three(typingctx, a, b, c):
        return signature(result, *kinds), generate

    def generate(context, builder, sig, args):
        return make(builder, *(splat(builder, value) for value in args))

    return (one, two, three)[len(kinds) - 1]


def call_llvm(builder, name, result, *args):
    """Call an intrinsic function of LLVM."""
    kinds = [value.type for value in args]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(result, kinds), f"llvm.{name}"
    )
    return builder.call(function, args)


#: A vector with one float32 in every lane.
spread = _operation(
    (types.float32,), floats, lambda builder, a: a, lambda a: np.full(LANES, a, np.float32)
)
#: The larger one of two, lane by lane, and the smaller one. If the first is no number, that stays.
larger = _operation(
    (floats, floats),
    floats,
    lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), b, a),
    lambda a, b: np.where(a < b, b, a).astype(np.float32),
)
smaller = _operation(
    (floats, floats),
    floats,
    lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), b, a),
    lambda a, b: np.where(a > b, b, a).astype(np.float32),
)
#: Of two vectors the first one's lanes where something is true, else the second one's.
where = _operation(
    (truths, floats, floats),
    floats,
    lambda builder, which, a, b: builder.select(which, a, b),
    lambda which, a, b: np.where(which, a, b).astype(np.float32),
)
where_whole = _operation(
    (truths, whole, whole),
    whole,
    lambda builder, which, a, b: builder.select(which, a, b),
    np.where,
)
#: Square roots.
root = _operation(
    (floats,), floats, lambda builder, a: call_llvm(builder, "sqrt.v16f32", FLOATS, a), np.sqrt
)


def _inverse_root(builder, a):
    if not HAS_AVX512:
        return builder.fdiv(constant(1.0), call_llvm(builder, "sqrt.v16f32", FLOATS, a))
    # Right to 14 bits, and after a step of Newton's to all but the last one or two.
    kinds = [FLOATS, FLOATS, ir.IntType(16)]
    function = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(FLOATS, kinds), "llvm.x86.avx512.rsqrt14.ps.512"
    )
    everything = ir.Constant(kinds[2], 0xFFFF)
    near = builder.call(function, [a, ir.Constant(FLOATS, None), everything])
    half = builder.fmul(builder.fmul(a, near, flags=FAST), constant(0.5), flags=FAST)
    left = builder.fsub(constant(1.5), builder.fmul(half, near, flags=FAST), flags=FAST)
    return builder.fmul(near, left, flags=FAST)


#: One over the square root, for positive numbers.
inverse_root = _operation(
    (floats,), floats, _inverse_root, lambda a: (np.float32(1.0) / np.sqrt(a)).astype(np.float32)
)
magnitude = _operation(
    (floats,), floats, lambda builder, a: call_llvm(builder, "fabs.v16f32", FLOATS, a), np.abs
)
#: Whole numbers as floats; floats rounded to the nearest whole number, to the even one of two.
as_floats = _operation(
    (whole,),
    floats,
    lambda builder, a: builder.sitofp(a, FLOATS),
    lambda a: a.astype(np.float32),
)
rounded = _operation(
    (floats,),
    whole,
    lambda builder, a: builder.fptosi(call_llvm(builder, "rint.v16f32", FLOATS, a), WHOLE),
    lambda a: np.rint(a).astype(np.int32),
)


def _sum(builder, vector):
    """Lanes added in a tree, always the same one."""
    count = LANES
    while count > 1:
        count //= 2
        halves = [
            builder.shuffle_vector(
                vector,
                vector,
                ir.Constant(ir.VectorType(INT32, count), list(range(low, low + count))),
            )
            for low in (0, count)
        ]
        vector = builder.fadd(*halves, flags=FAST)
    return builder.extract_element(vector, ir.Constant(INT32, 0))


#: Sum over the lanes.
total = _operation((floats,), types.float32, _sum, lambda a: a.sum(dtype=np.float32))
