"""Claim: this is the paper's set-up of section 3.2 and appendices A and B, in simulation, with a
sensor fitted to recordings.

    jaxunshear run experiments/paper.py

Expected: the paper's MS-SSIM on real data is 0.93 disentangled, 0.90 entangled, 0.32 sheared
(Table 1). The experiment has not been run in full. Data and training need a GPU: 120,000 images of
contacts in pairs, 30,000 of poses, 100 and 250 epochs. We estimate, by ten times the steps of
experiments/paper_tenth.py, an hour on an H200 for the two networks that unshear. A small version
takes minutes: `--paired.poses 10 --paired.taps 1 --paired.slides 2 --pose.poses 20 --train.epochs 1
--train_posenet.epochs 1 --train_posenet.batch 32`.

How we read the text: "10e-4" is 1e-3, the weight of the mean of each kernel's |w| and w^2. Their
sum, as Keras takes it, is 52 times the first image loss of UnshearNet and 640 times that of
PoseNet, and shrinks the kernels before they learn (experiments/ablations/appendix_b.py). "10:1" is
a weight of 0.1 on the patch loss; "one-fifth and one-tenth" are factors on the first learning rate.

As in the paper, a slide is paired with a tap whose depth misses its own by up to 1 mm, which no
network can foresee. A further test has taps of the slide's own depth. Sensor, camera and friction
are those fitted to recordings of a TacTip (docs/calibration.md), because the paper's are unknown.
The paper states widths and kernels in figures that its text lacks: these are ours (docs/model.md).
"""

from dataclasses import replace

from jaxunshear.config.configs import PAIRED, POSE, get_config_sensor
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PoseNet, UnshearNet
from jaxunshear.config.training import POSENET_TRAINING, Training

SIZE = 256

POSENET = replace(
    POSENET_TRAINING,
    epochs=250,
    batch=256,
    learning_rate=1e-4,
    beta1=0.5,
    drops=((100, 1 / 2), (200, 1 / 10)),
    l1=1e-3,
    l2=1e-3,
    kernels="mean",
    ema_decay=0.0,
    shift=0.02,
    validate_every=70,  # an epoch: 18,000 taps
)

experiment = Experiment(
    name="paper",
    claim="The paper's set-up, in simulation.",
    other_jitters_mm=(0.0,),  # also against taps of the slide's own depth
    sensor=get_config_sensor("paper"),
    paired=PAIRED["paper"],  # 200 poses x 3 shapes: 50 taps with +-1 mm of depth, 150 slides
    pose=POSE["paper"],  # 10,000 taps x 3 shapes
    # codes 8x8x64
    unshear=UnshearNet(size=SIZE, widths=(32, 64, 64, 64, 64), pose_channels=64, shear_channels=64),
    posenet=PoseNet(size=SIZE),
    train=Training(
        epochs=100,
        batch=32,
        learning_rate=1e-4,
        beta1=0.5,
        drops=((40, 1 / 5), (80, 1 / 10)),
        l1=1e-3,
        l2=1e-3,
        kernels="mean",
        losses={"supervised": 1.0, "patch": 0.1, "reconstruction": 1.0},
        crops=100,
        crop_px=20,
        ema_decay=0.0,
        shift=0.02,
        validate_every=1687,  # an epoch: 54,000 sheared images
    ),
    train_posenet=POSENET,
    train_teacher=POSENET,
)
