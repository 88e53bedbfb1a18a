"""Counter-based random numbers: a pure function of key and counter, with no generator to store.

Threefry-2x32 with 20 rounds (Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"), in integer torch
operations, so that the numbers are the same on every device, for any subset of environments, and after a resume.
"""

import hashlib
import math

import torch
from torch import Tensor

_MASK = 0xFFFFFFFF
_PARITY = 0x1BD11BDA
_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def threefry(key: tuple[Tensor, Tensor], counter: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return two 32-bit words per counter.

    Key and counter have two words each. All words are int64 below 2^32 and are broadcast together.
    """
    k0, k1 = key
    keys = (k0, k1, k0 ^ k1 ^ _PARITY)
    x0, x1 = torch.broadcast_tensors((counter[0] + k0) & _MASK, (counter[1] + k1) & _MASK)
    for block in range(5):
        for r in _ROTATIONS[block % 2]:
            x0 = (x0 + x1) & _MASK
            x1 = (((x1 << r) & _MASK) | (x1 >> (32 - r))) ^ x0
        x0 = (x0 + keys[(block + 1) % 3]) & _MASK
        x1 = (x1 + keys[(block + 2) % 3] + (block + 1)) & _MASK
    return x0, x1


def env_keys(seed: int, name: str, count: int, device: torch.device) -> Tensor:
    """Return one key (two words) per environment of a class, int64 (count, 2); keys depend on seed, class and index."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    words = [torch.tensor(int.from_bytes(digest[i : i + 4], "little"), device=device) for i in (0, 4)]
    index = torch.arange(count, device=device)
    return torch.stack(threefry((words[0], words[1]), (index, torch.zeros_like(index))), dim=1)


def derived(keys: Tensor, episode: Tensor, stream: int) -> Tensor:
    """Return the keys (n, 2) of another stream of random numbers in each environment's episode.

    They depend on the environments' keys (n, 2), the numbers of the episodes (n,) and the number of the stream.
    """
    beyond = torch.full_like(episode, _MASK - stream)  # the episode's own draws never count up to this number
    return torch.stack(threefry((keys[:, 0], keys[:, 1]), (episode, beyond)), dim=1)


def normal(keys: Tensor, episode: Tensor, draws: int) -> Tensor:
    """Return standard normal numbers, float32 (n, draws); the arguments are those of ``uniform``."""
    pairs = uniform(keys, episode, draws + draws % 2).float().unflatten(1, (-1, 2))
    radius = (-2.0 * torch.log1p(-pairs[..., 0])).sqrt()
    angle = 2.0 * math.pi * pairs[..., 1]
    return torch.stack((radius * angle.cos(), radius * angle.sin()), dim=2).flatten(1)[:, :draws]


def uniform(keys: Tensor, episode: Tensor, draws: int) -> Tensor:
    """Return uniform numbers in [0, 1), float64 (n, draws).

    A number depends only on its key (n, 2), its episode (n,) and the index of the draw. All numbers are multiples of
    2^-24 and therefore exact in single precision.
    """
    pairs = torch.arange((draws + 1) // 2, device=keys.device)
    words = threefry((keys[:, :1], keys[:, 1:]), (episode[:, None], pairs[None]))
    bits = torch.stack(words, dim=2).flatten(1)[:, :draws]
    return (bits >> 8).double() * 2.0**-24
