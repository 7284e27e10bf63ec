"""Training on labelled clouds alone: the row without adaptation, and the *Supervised* row."""

from torch import Generator

from qs3.adaptation.method import Batch, Method, Target, Terms


class SourceOnly(Method):
    """Cross entropy on the source.

    With the target's labelled training part as its source it is the paper's *Supervised*.
    """

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source batch."""
        return {"source": self.classification(self.model(source.points), source)}
