"""Semantic pointers: vectors for names, and for what is made of them by binding and adding."""

import ast
import difflib
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from neuroslam.errors import SpaceError
from neuroslam.spiking.algebra import bind, invert, make_unitary


class SemanticPointers(nn.Module):
    """A vocabulary: one vector for each name; ``*`` binds, ``+`` adds, ``~`` inverts.

    State: ``vectors``, ``(names, n_features)``.

    Args:
        names: Words that can stand in an expression, such as ``BLUE``.
        n_features: Of each vector; an odd number, as of a space.
        seed: Of the vectors.
        how: ``"unitary"`` binds without loss, for what is made into structures; ``"orthogonal"``
            does not interfere, for names of landmarks; ``"random"`` has length 1 only.

    Raises:
        SpaceError: If a name cannot be one, is there twice, or there are more than features
            that shall be orthogonal.

    Example:
        >>> words = SemanticPointers(["BLUE", "RED", "SQUARE"], 55)
        >>> words.decode(words.parse("BLUE * SQUARE * ~BLUE"))
        'SQUARE'
    """

    vectors: Tensor

    def __init__(
        self,
        names: Sequence[str],
        n_features: int,
        seed: int = 0,
        how: Literal["unitary", "orthogonal", "random"] = "unitary",
    ) -> None:
        super().__init__()
        wrong = [name for name in names if not name.isidentifier()]
        if wrong or len(set(names)) < len(names):
            raise SpaceError(
                f"SemanticPointers: names {wrong or list(names)}, expected different words of "
                "letters, digits and underscores"
            )
        if how == "orthogonal" and len(names) > n_features:
            raise SpaceError(
                f"SemanticPointers: {len(names)} orthogonal vectors need as many features, got "
                f"{n_features}; use more features, or unitary ones"
            )
        self.names = tuple(names)
        draw = torch.Generator().manual_seed(seed)
        vectors = torch.randn(len(names), n_features, generator=draw, dtype=torch.float64)
        vectors = vectors / vectors.norm(dim=-1, keepdim=True)
        if how != "random":
            vectors = make_unitary(vectors)
        if how == "orthogonal":
            q, r = torch.linalg.qr(vectors.T)
            vectors = (q * r.diagonal().sign()).T
        self.register_buffer("vectors", vectors.to(torch.get_default_dtype()).contiguous())

    @property
    def n_features(self) -> int:
        """Of each vector."""
        return self.vectors.shape[1]

    def __getitem__(self, name: str) -> Tensor:
        """Return the vector of a name.

        Raises:
            SpaceError: If it is not in the vocabulary; with names that are like it.
        """
        if name not in self.names:
            near = difflib.get_close_matches(name, self.names) or list(self.names)[:5]
            raise SpaceError(f"SemanticPointers: no pointer {name!r}; there is {', '.join(near)}")
        return self.vectors[self.names.index(name)]

    def parse(self, expression: str) -> Tensor:
        """Return the vector of an expression, such as ``BLUE * (SQUARE + TRIANGLE)``.

        Raises:
            SpaceError: If it is none, or has a name that is not in the vocabulary.
        """
        try:
            tree = ast.parse(expression.strip(), mode="eval").body
        except (SyntaxError, ValueError):
            tree = None
        return self._value(tree, expression)

    def _value(self, node: ast.AST | None, whole: str) -> Tensor:
        match node:
            case ast.Name(id=name):
                return self[name]
            case ast.BinOp(left=left, op=ast.Mult(), right=right):
                return bind(self._value(left, whole), self._value(right, whole))
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                return self._value(left, whole) + self._value(right, whole)
            case ast.UnaryOp(op=ast.Invert(), operand=operand):
                return invert(self._value(operand, whole))
        raise SpaceError(
            f"SemanticPointers: cannot read {whole!r}; write names, * to bind, + to add, "
            "~ to invert, and brackets"
        )

    def parse_all(self, expressions: Sequence[str]) -> Tensor:
        """Return the vectors of expressions, of length 1, ``(n, n_features)``."""
        vectors = torch.stack([self.parse(e) for e in expressions])
        return vectors / vectors.norm(dim=-1, keepdim=True)

    def similarity(self, vector: Tensor) -> Tensor:
        """Return how alike vectors are to each name's, ``(..., n_features)`` to ``(..., n)``."""
        if vector.shape[-1] != self.n_features:
            raise SpaceError(
                f"SemanticPointers: a vector of {vector.shape[-1]} features, the vocabulary has "
                f"{self.n_features}"
            )
        unit = vector / vector.norm(dim=-1, keepdim=True).clamp_min(1e-12)
        return unit @ (self.vectors / self.vectors.norm(dim=-1, keepdim=True)).T

    def decode(self, vector: Tensor) -> str:
        """Return the name that a vector, ``(n_features,)``, is most like."""
        return self.names[int(self.similarity(vector).argmax())]

    def clean_up(self, vector: Tensor) -> Tensor:
        """Return the vectors of the names that vectors are most like, the same shape."""
        return self.vectors[self.similarity(vector).argmax(-1)]
