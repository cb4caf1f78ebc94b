"""Reconstruction networks as methods: E2VID, E2VID+ (the paper's ECNN), FireNet, FireNet+, HyperE2VID.

They see events only. The architectures are written from the papers; layer sizes and the names of tensors are those of
the published checkpoints, so that these load as they are. Weights do not ship with kalux: the user gives the file, and
`kalux.evaluation.learned.catalogue` says where the authors publish it. Needs PyTorch, ``pip install 'kalux[learned]'``;
only `networks`, `weights` and `runner` import it.
"""

from __future__ import annotations
