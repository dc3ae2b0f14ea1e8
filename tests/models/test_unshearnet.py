"""UnshearNet: shapes, what depends on what, and which loss reaches which module."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import UnshearNet
from jaxunshear.errors import Note, UserError
from jaxunshear.models import distances, unshearnet
from jaxunshear.training.trainer import get_compile_options
from tests.helpers.gradients import list_taught_parts

quick_init = jax.jit(unshearnet.init, static_argnums=0, compiler_options=get_compile_options())

KEY = jax.random.key(0)
NET = UnshearNet(size=32, widths=(6, 8, 8), pose_channels=4, shear_channels=3)
ENTANGLED = UnshearNet(size=32, widths=(6, 8, 8), disentangled=False)
APART = UnshearNet(size=32, widths=(6, 8, 8), pose_channels=4, shear_channels=3, apart=True)


@pytest.fixture(scope="module")
def variables():
    return quick_init(NET, jax.random.key(0))


@pytest.fixture(scope="module")
def images():
    return (jax.random.uniform(jax.random.key(1), (5, 32, 32, 1)) > 0.7).astype(jnp.float32)


@pytest.mark.parametrize("jit", [pytest.param(False, marks=pytest.mark.long), True])
def test_shapes(variables, images, jit):
    wrap = jax.jit if jit else lambda f: f
    z_p, z_s = wrap(lambda v, x: unshearnet.encode(NET, v, x))(variables, images)
    assert (z_p.shape, z_s.shape) == ((5, 4, 4, 4), (5, 4, 4, 3))
    canonical = wrap(lambda v, z: unshearnet.decode_canonical(NET, v, z))(variables, z_p)
    sheared = wrap(lambda v, *z: unshearnet.decode_sheared(NET, v, *z))(variables, z_p, z_s)
    assert canonical.shape == sheared.shape == images.shape
    unsheared = wrap(lambda v, x: unshearnet.unshear(NET, v, x))(variables, images)
    np.testing.assert_allclose(unsheared, jax.nn.sigmoid(canonical), atol=1e-6)


def test_released_weights_give_the_pose_code_and_say_so(variables, images):
    released = {
        kind: {n: v for n, v in held.items() if n not in ("shear", "DS")}
        for kind, held in variables.items()
    }
    with pytest.warns(Note, match="no shear code, as released ones do: z_p alone is given"):
        z_p, z_s = unshearnet.encode(NET, released, images)
    assert z_s is None
    entire, other = unshearnet.encode(NET, variables, images)
    np.testing.assert_array_equal(z_p, entire)
    with pytest.raises(UserError, match="no DS"):
        unshearnet.decode_sheared(NET, released, entire, other)


def test_the_paper_at_256_px_has_codes_of_8_by_8():
    net = UnshearNet(size=256, widths=(32, 64, 64, 64, 64), pose_channels=64, shear_channels=64)
    variables = jax.eval_shape(lambda key: unshearnet.init(net, key), jax.random.key(0))
    images = jax.ShapeDtypeStruct((2, 256, 256, 1), jnp.float32)
    z_p, z_s = jax.eval_shape(lambda v, x: unshearnet.encode(net, v, x), variables, images)
    assert z_p.shape == z_s.shape == (2, 8, 8, 64)
    again = jax.eval_shape(lambda v, *z: unshearnet.decode_sheared(net, v, *z), variables, z_p, z_s)
    assert again.shape == images.shape


def test_entangled_has_one_code_and_one_decoder(images):
    variables = quick_init(ENTANGLED, jax.random.key(0))
    assert set(variables["params"]) == {"E", "DC"}
    z, nothing = jax.eval_shape(lambda v, x: unshearnet.encode(ENTANGLED, v, x), variables, images)
    assert nothing is None
    assert z.shape == (5, 4, 4, 8)
    found, _ = jax.eval_shape(partial(unshearnet.reconstruct, ENTANGLED), variables, images)
    assert found.z_p.shape == (5, 4, 4, 8)
    assert found.canonical.shape == images.shape
    assert found.sheared is None and found.z_s is None


def test_unshear_needs_neither_the_shear_code_nor_its_decoder(variables, images):
    pruned = {
        kind: {m: v for m, v in tree.items() if m not in ("shear", "DS")}
        for kind, tree in variables.items()
    }
    got = unshearnet.unshear(NET, pruned, images)
    np.testing.assert_array_equal(got, unshearnet.unshear(NET, variables, images))


def test_canonical_image_has_exactly_no_gradient_toward_the_shear_code(variables, images):
    def trained(params):
        return jnp.sum(
            unshearnet.reconstruct(NET, variables | {"params": params}, images, KEY)[0].canonical
            ** 2
        )

    def used(params):
        z_p, _ = unshearnet.encode(NET, variables | {"params": params}, images)
        return jnp.sum(unshearnet.decode_canonical(NET, variables | {"params": params}, z_p) ** 2)

    for canonical in (trained, used):
        gradient = jax.jit(jax.grad(canonical))(variables["params"])
        assert list_taught_parts(gradient) == {"E", "pose", "DC"}


def test_one_sum_gives_each_module_the_gradient_of_the_papers_own_loss(variables, images):
    """DC: the supervised and the patch term; DS: the reconstruction. Paper section 3.3."""
    target = jnp.roll(images, 2, 1)
    corners = distances.sample_corners(jax.random.key(2), 5, 10, 32, 8)

    def loss(params, reconstruction, canonicals):
        found, _ = unshearnet.reconstruct(NET, variables | {"params": params}, images, KEY)
        canonical, sheared = jax.nn.sigmoid(found.canonical), jax.nn.sigmoid(found.sheared)
        rec = distances.compute_supervised_loss(sheared, images)
        sup = distances.compute_supervised_loss(canonical, target)
        patch = 0.1 * distances.compute_patch_loss(
            canonical, target, distances.count_crop_coverage(corners, 32, 8)
        )
        return reconstruction * jnp.mean(rec) + canonicals * (jnp.mean(sup) + jnp.mean(patch))

    gradient = jax.jit(jax.grad(loss))
    total = gradient(variables["params"], 1.0, 1.0)
    own = {("shear", "DS"): (1.0, 0.0), ("DC",): (0.0, 1.0)}
    for modules, weights in own.items():
        expected = gradient(variables["params"], *weights)
        for module in modules:
            for a, b in zip(
                jax.tree.leaves(total[module]), jax.tree.leaves(expected[module]), strict=True
            ):
                np.testing.assert_allclose(a, b, atol=1e-6 * float(jnp.abs(b).max()) + 1e-12)


def test_inference_does_not_depend_on_the_batch(variables, images):
    unshear = jax.jit(unshearnet.unshear, static_argnums=0)
    entire = unshear(NET, variables, images)
    for one in range(5):
        np.testing.assert_allclose(
            unshear(NET, variables, images[one : one + 1])[0], entire[one], atol=1e-6
        )


def test_initial_weights_are_normal_with_deviation_002(variables):
    big = quick_init(UnshearNet(), jax.random.key(3))
    kernels = [
        x
        for path, x in jax.tree_util.tree_leaves_with_path(big["params"])
        if path[-1].key == "kernel"
    ]
    values = np.concatenate([np.ravel(kernel) for kernel in kernels])
    assert abs(values.mean()) < 1e-4
    assert abs(values.std() - 0.02) < 1e-4


@pytest.mark.parametrize(
    ("net", "field"),
    [
        (UnshearNet(size=100), "size"),
        (UnshearNet(widths=(8,)), "widths"),
        (UnshearNet(widths=()), "widths"),
    ],
)
def test_sizes_that_do_not_fit_are_refused_by_name(net, field):
    with pytest.raises(UserError, match=field):
        unshearnet.init(net, jax.random.key(0))


def test_codes_that_are_apart_are_numbers_without_place(images):
    variables = quick_init(APART, jax.random.key(0))
    assert set(variables["params"]) == {"E", "ES", "pose", "shear", "DC", "DS"}
    z_p, z_s = unshearnet.encode(APART, variables, images)
    assert (z_p.shape, z_s.shape) == ((5, 1, 1, 4), (5, 1, 1, 3))
    assert unshearnet.decode_sheared(APART, variables, z_p, z_s).shape == images.shape
    for scale in (1e3, 1e6):  # however large the layer's weights have grown
        large = jax.tree.map(lambda leaf, by=scale: by * leaf, variables["params"]["pose"])
        grown = variables | {"params": variables["params"] | {"pose": large}}
        numbers = unshearnet.encode(APART, grown, images)[0]
        np.testing.assert_allclose(numbers.mean(-1), 0, atol=1e-5)
        np.testing.assert_allclose(numbers.var(-1), 1, atol=0.02)
    canonical = jax.nn.sigmoid(unshearnet.decode_canonical(APART, variables, z_p))
    np.testing.assert_allclose(unshearnet.unshear(APART, variables, images), canonical, atol=1e-6)


def test_of_codes_that_are_apart_each_term_teaches_its_own_module(images):
    variables = quick_init(APART, jax.random.key(0))
    partners = jnp.roll(images, 3, 1), jnp.roll(images, 5, 2)

    def term(params, name):
        found, _ = unshearnet.reconstruct(
            APART, variables | {"params": params}, images, KEY, *partners
        )
        return jnp.sum(jnp.square(getattr(found, name)))

    taught = {
        "canonical": {"E", "pose", "DC"},
        "sheared": {"DS"},
        "counterfactual": {"DS"},
        "disagreement": {"E", "pose"},
        "same_pose": {"E", "pose", "DC"},
        "z_s": {"ES", "shear"},
    }
    slope = jax.jit(jax.grad(term), static_argnums=1)
    for name, modules in taught.items():
        assert list_taught_parts(slope(variables["params"], name)) == modules, name


def test_partners_of_codes_that_are_apart(images):
    """A contact that is its own partner agrees with itself; without partners nothing is exchanged, and the decoders draw the same."""
    variables = quick_init(APART, jax.random.key(0))
    itself, _ = unshearnet.reconstruct(APART, variables, images, KEY, images, images)
    np.testing.assert_allclose(itself.disagreement, 0, atol=1e-9)
    np.testing.assert_allclose(itself.counterfactual, itself.sheared, atol=1e-5)
    alone, statistics = unshearnet.reconstruct(APART, variables, images, KEY)
    assert alone.counterfactual is None and alone.disagreement is None and alone.same_pose is None
    np.testing.assert_allclose(itself.same_pose, itself.canonical, atol=1e-5)
    for name in ("canonical", "sheared", "z_p", "z_s"):
        np.testing.assert_allclose(getattr(alone, name), getattr(itself, name), atol=1e-5)
    assert jax.tree.structure(statistics) == jax.tree.structure(variables["batch_stats"])
    network = unshearnet.Network(APART)
    (z_p, z_s), _ = network.apply(variables, images, True, method="encode", mutable=["batch_stats"])
    np.testing.assert_allclose(alone.z_p, z_p, atol=1e-6)
    np.testing.assert_allclose(alone.z_s, z_s, atol=1e-6)
