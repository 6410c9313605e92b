"""Words in pictures: measured as they are drawn, and shortened where they are too wide."""

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import FigureBase
from matplotlib.text import Text
from matplotlib.transforms import Bbox

ELLIPSIS = "…"


def extent_of(text: Text) -> Bbox:
    """Box of a text as it is drawn, pixels from the lower left corner."""
    figure = text.get_figure(root=True)
    assert figure is not None  # noqa: S101 - it was drawn on one
    canvas = figure.canvas
    if not isinstance(canvas, FigureCanvasAgg):
        canvas = FigureCanvasAgg(figure)
    return text.get_window_extent(canvas.get_renderer())  # type: ignore[no-untyped-call]


def width_of(figure: FigureBase, words: str, size: float) -> float:
    """Pixels that a line of words takes in a font of that size, points."""
    text = figure.text(0.0, 0.0, words, fontsize=size)
    try:
        return float(extent_of(text).width)
    finally:
        text.remove()


def shortened(figure: FigureBase, words: str, size: float, most: float) -> str:
    """Words that take at most `most` pixels; the middle of longer ones is left out."""
    if width_of(figure, words, size) <= most:
        return words
    low, high = 0, len(words) - 1  # letters that are kept; `low` fits, if any number does
    while low < high:
        kept = (low + high + 1) // 2
        if width_of(figure, _without_middle(words, kept), size) <= most:
            low = kept
        else:
            high = kept - 1
    return _without_middle(words, low)


def in_lines(figure: FigureBase, words: str, size: float, most: float, count: int) -> list[str]:
    """Break words into at most `count` lines of at most `most` pixels; what is over is left out."""
    lines: list[str] = []
    for word in words.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and width_of(figure, longer, size) <= most:
            lines[-1] = longer
        else:
            lines.append(word)
    if len(lines) > count:
        last = lines[count - 1].split()
        while len(last) > 1 and width_of(figure, " ".join(last) + ELLIPSIS, size) > most:
            last.pop()
        lines[count - 1 :] = [" ".join(last) + ELLIPSIS]
    return [shortened(figure, line, size, most) for line in lines]


def _without_middle(words: str, kept: int) -> str:
    """Words with `kept` of their letters, half from either end, and an ellipsis between."""
    head = (kept + 1) // 2
    tail = kept - head
    return words[:head].rstrip() + ELLIPSIS + (words[len(words) - tail :].lstrip() if tail else "")
