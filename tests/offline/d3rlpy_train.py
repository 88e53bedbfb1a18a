"""Run by an interpreter that has d3rlpy: TD3+BC or IQL on stored episodes with Table 46's numbers, to a TorchScript.

    python d3rlpy_train.py DATA.npz td3bc|iql UPDATES SEED POLICY.pt

The file holds observations, actions, rewards, terminals and timeouts, a row a step. d3rlpy leaves out the last step of
an episode that was cut by time: it has no state after it there.
"""

import sys

import d3rlpy
import numpy as np


def main(path: str, algo: str, updates: int, seed: int, out: str) -> None:
    d3rlpy.seed(seed)
    stored = np.load(path)
    # The action space is given, because actions at their bounds look like whole numbers.
    kind = d3rlpy.ActionSpace.CONTINUOUS
    data = d3rlpy.dataset.MDPDataset(**{name: stored[name] for name in stored.files}, action_space=kind)
    shared = {"batch_size": 256, "gamma": 0.99, "tau": 0.005, "actor_learning_rate": 3e-4, "critic_learning_rate": 3e-4}
    if algo == "td3bc":
        config = d3rlpy.algos.TD3PlusBCConfig(
            **shared, alpha=0.2, observation_scaler=d3rlpy.preprocessing.StandardObservationScaler()
        )
    else:
        config = d3rlpy.algos.IQLConfig(**shared, expectile=0.7, weight_temp=3.0, max_weight=100.0)
    learner = config.create(device="cpu:0")
    quiet = d3rlpy.logging.NoopAdapterFactory()
    learner.fit(data, updates, min(updates, 1000), logger_adapter=quiet, show_progress=False)
    learner.save_policy(out)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
