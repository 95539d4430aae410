"""ONNX file of a network that takes clicks and marks everything that has the colour under the clicks."""

from __future__ import annotations

from tests.support import onnx

SIDE = 1024


def alike(*, threshold: float = 0.01, gain: float = 1.0, inputs: tuple[str, ...] = ("", "", "")) -> bytes:
    """Return a network that marks pixels of the colour under the clicks on the object.

    A pixel is marked if its squared difference from the mean colour under the clicks is below ``threshold``. Hat
    functions select the clicked pixels; ``gain`` scales the output.
    """
    image, coords, labels = (
        name or default
        for name, default in zip(
            inputs, ("batched_images", "batched_point_coords", "batched_point_labels"), strict=True
        )
    )
    middles = [k + 0.5 for k in range(SIDE)]
    nodes = [
        onnx.node("MatMul", [coords, "first"], ["x"]),
        onnx.node("MatMul", [coords, "second"], ["y_column"]),
        onnx.node("Reshape", ["y_column", "as_row"], ["y"]),
        onnx.node("Relu", [labels], ["meant"]),
        onnx.node("Reshape", ["meant", "as_row"], ["weight"]),
        *_hat("columns", "x", "wide"),
        *_hat("rows", "y", "high"),
        onnx.node("Mul", ["high", "weight"], ["high_meant"]),
        onnx.node("MatMul", ["high_meant", "wide"], ["where"]),
        onnx.node("Mul", [image, "where"], ["lit"]),
        onnx.node("ReduceSum", ["lit", "plane_axes"], ["light"]),
        onnx.node("ReduceSum", ["where", "plane_axes"], ["area"]),
        onnx.node("Div", ["light", "area"], ["colour"]),
        onnx.node("Sub", [image, "colour"], ["apart"]),
        onnx.node("Mul", ["apart", "apart"], ["squares"]),
        onnx.node("ReduceSum", ["squares", "colour_axis"], ["far"]),
        onnx.node("Sub", ["threshold", "far"], ["near"]),
        onnx.node("Mul", ["near", "gain"], ["answer"]),
        onnx.node("Reshape", ["answer", "as_masks"], ["output_masks"]),
    ]
    constants = [
        onnx.tensor("first", [2, 1], [1.0, 0.0]),
        onnx.tensor("second", [2, 1], [0.0, 1.0]),
        onnx.tensor("one", [1], [1.0]),
        onnx.tensor("threshold", [1], [threshold]),
        onnx.tensor("gain", [1], [gain]),
        onnx.tensor("columns", [1, 1, 1, SIDE], middles),
        onnx.tensor("rows", [1, 1, SIDE, 1], middles),
        onnx.integers("as_row", [1, 1, 1, 6]),
        onnx.integers("as_masks", [1, 1, 1, SIDE, SIDE]),
        onnx.integers("plane_axes", [2, 3]),
        onnx.integers("colour_axis", [1]),
    ]
    return onnx.model(
        nodes,
        constants,
        [
            onnx.value(image, [1, 3, SIDE, SIDE]),
            onnx.value(coords, [1, 1, 6, 2]),
            onnx.value(labels, [1, 1, 6]),
        ],
        [onnx.value("output_masks", [1, 1, 1, SIDE, SIDE])],
    )


def _hat(grid: str, centre: str, name: str) -> list[bytes]:
    """Return the graph nodes that compute the hat function max(0, 1 - |grid - centre|)."""
    return [
        onnx.node("Sub", [grid, centre], [f"{name}_off"]),
        onnx.node("Abs", [f"{name}_off"], [f"{name}_away"]),
        onnx.node("Sub", ["one", f"{name}_away"], [f"{name}_left"]),
        onnx.node("Relu", [f"{name}_left"], [name]),
    ]
