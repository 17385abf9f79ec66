"""Trains one configuration from several seeds, one after the other; run it again to resume.

    python train/seeds.py train/short.toml runs/short 0 1 2
    python train/seeds.py my_training.toml runs/mine 0 1 2 --device cuda --target 0.95

Everything after the seeds goes to `lunar-mjx train`, which says what it takes with --help. Copy a file of this folder
to begin a training of your own: it names the environment, its options, and how to train in it.
"""

import subprocess
import sys


def main(training: str, out: str, *words: str) -> None:
    """Runs `lunar-mjx train` for every seed among the words; the first word that is no number ends the seeds."""
    count = next((i for i, word in enumerate(words) if not word.isdigit()), len(words))
    for seed in words[:count]:
        line = ["-m", "lunar_mjx.cli", "train", training, "--out", f"{out}/seed{seed}", "--seed", seed]
        subprocess.run([sys.executable, *line, *words[count:]], check=True)


if __name__ == "__main__":
    main(*sys.argv[1:]) if len(sys.argv) > 3 else print(__doc__)
