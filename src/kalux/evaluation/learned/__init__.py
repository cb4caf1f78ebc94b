"""Reconstruction networks as methods: E2VID, E2VID+ (the paper's ECNN), FireNet, FireNet+, HyperE2VID.

They see events only. The networks are written anew; what the papers leave open (sizes, names of tensors, order of
operations) is as in the authors' public code and checkpoints, so that these load as they are. Weights do not ship
with kalux: the user gives the file, and `kalux.evaluation.learned.catalogue` says where the authors publish it. Needs
PyTorch, ``pip install 'kalux[learned]'``; only `networks`, `weights` and `runner` import it.
"""

from __future__ import annotations
