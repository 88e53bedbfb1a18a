import pytest
import torch

from bidex_algos.nets.networks import use_bfloat16

CPU = torch.device("cpu")


@pytest.mark.parametrize("tells", [(), ("_is_amx_tile_supported",), ("_is_avx512_bf16_supported",)])
def test_auto_takes_bfloat16_where_the_processor_multiplies_it(tells: tuple[str, ...], monkeypatch: pytest.MonkeyPatch):
    for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        monkeypatch.setattr(torch.cpu, name, lambda told=name in tells: told, raising=False)
    assert use_bfloat16("auto", CPU) == bool(tells)
    assert use_bfloat16("on", CPU) and not use_bfloat16("off", CPU)


def test_auto_is_float32_where_pytorch_cannot_tell(monkeypatch: pytest.MonkeyPatch):
    for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
        monkeypatch.delattr(torch.cpu, name, raising=False)
    assert not use_bfloat16("auto", CPU)
