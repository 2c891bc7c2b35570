"""Training and acting with LeRobot's commands, the way they are tried (rows.py)."""

from pathlib import Path

from .dataset_rows import DATASETS, MACHINES
from .robot_rows import ROBOTS
from .rows import Row, Try, ends_well, evaluates, holds, reaches, says, writes

PAIR = Path(__file__).parent / "inside/async_pair.py"
MODEL = "checkpoints/last/pretrained_model/model.safetensors"
ADAPTER = "checkpoints/last/pretrained_model/adapter_model.safetensors"
ONLINE = "`cqn-train`, which acts and learns in one process, in environments and on arms."
NO_BUS = (
    "It drives motors through a robot's bus, which the simulated arm, like other robots without one, does not have."
)

TRAIN = (
    Row(
        "lerobot-train",
        (Try("lerobot-train $CQN $RUN $DATA --steps=3 --output_dir=offline", writes(f"offline/{MODEL}")),),
        {"": "Offline; `cqn-train` goes on online."},
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train --resume=true --steps=5 "
                "--config_path=offline/checkpoints/last/pretrained_model/train_config.json",
                reaches("offline", 5),
            ),
        ),
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train --policy.path=offline/checkpoints/last/pretrained_model $RUN $DATA --steps=2 "
                "--output_dir=further",
                writes(f"further/{MODEL}"),
            ),
        ),
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train $CQN $RUN $DATA $STATION $ONE --env_eval_freq=2 --steps=2 --output_dir=watched",
                writes("watched/eval/videos*/**/*.mp4"),
            ),
        ),
        {"": "With evaluation on the way."},
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train --policy.type=drqv2 --policy.preset=laptop_state --policy.device=cpu $RUN $DATA "
                "--steps=2 --output_dir=drqv2",
                writes(f"drqv2/{MODEL}"),
            ),
        ),
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train $CQN $RUN $DATA --policy.use_amp=true --steps=2 --output_dir=amp", writes(f"amp/{MODEL}")
            ),
        ),
        {"": "On a CPU LeRobot switches mixed precision off; not tried on a GPU here."},
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train $CQN $RUN $DATA --policy.compile_model=true --steps=2 --output_dir=compiled",
                writes(f"compiled/{MODEL}"),
            ),
        ),
        {"compile_model": "The option belongs to some of LeRobot's policies only."},
        "leave it out; the network is small.",
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train --policy.path=offline/checkpoints/last/pretrained_model --peft.method_type=LORA $RUN "
                "$DATA "
                "--steps=2 --output_dir=plain_lora",
                writes(f"plain_lora/{ADAPTER}"),
            ),
            Try(
                "lerobot-train --policy.path=offline/checkpoints/last/pretrained_model --peft.method_type=LORA "
                "--peft.target_modules=all-linear $RUN $DATA --steps=2 --output_dir=lora",
                writes(f"lora/{ADAPTER}"),
                label="`--peft.target_modules`",
            ),
        ),
        {"target_modules": "The policy names no modules of its own for adapters."},
    ),
    Row(
        "torchrun",
        (
            Try(
                "torchrun --nproc_per_node=2 -m lerobot.scripts.lerobot_train $CQN $RUN $DATA --steps=3 "
                "--output_dir=two",
                says(r"batch size: 4 x 2 (= 8|dp workers)"),
            ),
        ),
        {"": "Two processes on a CPU; several GPUs were not tried."},
    ),
    Row(
        "lerobot-train",
        (
            Try(
                "lerobot-train $CQN --batch_size=4 --num_workers=0 --wandb.enable=false $DATA "
                "--policy.push_to_hub=false --policy.repo_id=user/checkpoints --save_checkpoint_to_hub=true --steps=2 "
                "--output_dir=uploaded",
                writes("hub/**/optimizer_state.safetensors", "hub/**/model.safetensors"),
                hub=True,
            ),
        ),
        {
            "": "Against a Hub on this machine. It sends the optimiser's state with every checkpoint; `cqn-push` "
            "sends what "
            "inference needs."
        },
    ),
)

USE = (
    Row(
        "lerobot-eval",
        (
            Try(
                "lerobot-eval --policy.path=offline/checkpoints/last/pretrained_model $STATION $ONE "
                "--policy.device=cpu --output_dir=evaluated",
                evaluates("evaluated"),
            ),
        ),
    ),
    Row(
        "lerobot-eval",
        (
            Try(
                "lerobot-eval --policy.path=lora/checkpoints/last/pretrained_model $STATION $ONE "
                "--policy.device=cpu --output_dir=evaluated_lora",
                evaluates("evaluated_lora"),
            ),
        ),
        {"": "With a LoRA adapter."},
    ),
    Row(
        "lerobot-record",
        (
            Try(
                "lerobot-record $ARM $LEADER --robot.speed=4 --teleop.hold_s=0.4 --dataset.repo_id=local/arm "
                "--dataset.root=arm --dataset.fps=40 --dataset.num_episodes=1 --dataset.single_task=Press "
                "--dataset.push_to_hub=false --play_sounds=false",
                holds("arm", 1),
                keys=True,
            ),
        ),
        {"": "`n` was pressed at *home* and *wait*."},
        then=(
            "cqn-data run arm_state --repo_id=local/arm --root=arm --new_repo_id=local/arm_clean --new_root=arm_clean",
            "lerobot-train $CQN $RUN --dataset.repo_id=local/arm_clean --dataset.root=arm_clean --steps=3 "
            "--output_dir=arm_offline",
        ),
    ),
    Row(
        "lerobot-teleoperate",
        (Try("lerobot-teleoperate $ARM $LEADER --fps=20 --teleop_time_s=3", says("Teleop loop time")),),
    ),
    Row(
        "lerobot-replay",
        (
            Try(
                "lerobot-replay $ARM --dataset.repo_id=local/arm --dataset.root=arm --dataset.episode=0 "
                "--dataset.fps=40 --play_sounds=false",
                says("Replaying episode"),
            ),
        ),
        {"": "It replays absolute goals: recordings as they are, not after `cqn-data delta`."},
    ),
    Row(
        "lerobot-rollout",
        (
            Try(
                "lerobot-rollout $POLICY $ARM --fps=10 --duration=3 --return_to_initial_position=false "
                "--play_sounds=false",
                says("Rollout finished"),
            ),
        ),
    ),
    Row(
        "lerobot-rollout",
        (
            Try(
                "lerobot-rollout $POLICY $ARM --fps=10 --duration=3 --strategy.type=sentry "
                "--dataset.repo_id=local/rollout_seen --dataset.root=seen --dataset.single_task=Press "
                "--dataset.push_to_hub=false --play_sounds=false",
                writes("seen/meta/info.json"),
            ),
        ),
        {"": "Records what it does."},
    ),
    Row(
        "lerobot-rollout",
        (
            Try(
                "lerobot-rollout $POLICY $ARM $LEADER --fps=10 --duration=3 --strategy.type=dagger "
                "--dataset.repo_id=local/rollout_dagger --dataset.root=dagger --dataset.single_task=Press "
                "--dataset.push_to_hub=false --play_sounds=false",
                says("Rollout finished"),
            ),
        ),
        {"": "Take-overs by key were not tried here; online, `cqn-train` has them."},
    ),
    Row(
        "lerobot-rollout",
        (
            Try(
                "lerobot-rollout $POLICY $ARM --fps=10 --duration=3 --inference.type=rtc --play_sounds=false",
                says("Rollout finished"),
            ),
        ),
        {
            "RTC inference is not supported": "Real-time chunking needs a policy that predicts chunks; CQN decides "
            "anew at every step."
        },
        "`--inference.type=sync`, the default.",
    ),
    Row(
        "python -m lerobot.async_inference.policy_server",
        (
            Try(
                f"python -P {PAIR} arm_offline/checkpoints/last/pretrained_model",
                says("Running inference for observation"),
                shown="policy_server --port=8080; robot_client $ARM --policy_type=cqn "
                "--pretrained_name_or_path=arm_offline/checkpoints/last/pretrained_model "
                "--server_address=127.0.0.1:8080",
            ),
        ),
        {
            "not supported. Supported policies": "The server has a fixed list of policies, which no plugin can extend; "
            "`robot_client` knows the simulated arm and is turned away with the policy."
        },
        "`lerobot-rollout` on the machine of the arm; a step takes milliseconds.",
    ),
    Row(
        "python -m lerobot.rl.learner",
        (Try("python -m lerobot.rl.learner $RL $DATA --output_dir=learner", writes("learner/logs/*")),),
        {
            "has no attribute 'concurrency'": "Actor and learner are made for LeRobot's SAC and read settings that "
            "only its "
            "policy has."
        },
        ONLINE,
    ),
    Row(
        "python -m lerobot.rl.actor",
        (Try("python -m lerobot.rl.actor $RL $DATA --output_dir=actor", writes("actor/logs/*")),),
        {"has no attribute 'concurrency'": "As the learner."},
        ONLINE,
    ),
    Row(
        "python -m lerobot.rl.gym_manipulator",
        (
            Try(
                "python -m lerobot.rl.gym_manipulator --config_path=manipulator.json "
                "--env.discover_packages_path=cqn_train.sim_arm",
                ends_well,
            ),
        ),
        {"has no attribute 'bus'": NO_BUS},
        "`lerobot-record`, then `cqn-train --robot.type=...`, which needs no bus.",
    ),
)

SECTIONS = {
    "Training": TRAIN,
    "Acting": USE,
    "Datasets": DATASETS,
    "Machines": MACHINES,
    "Other people's robots": ROBOTS,
}
