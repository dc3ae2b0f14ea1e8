"""UnshearNet: shapes, what depends on what, and which loss reaches which module."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.networks import UnshearNet
from jaxunshear.errors import Note, UserError
from jaxunshear.models import distances, unshearnet
from jaxunshear.training.trainer import get_compile_options
from tests.helpers.network_parts import drop_parts, find_taught_parts

quick_init = jax.jit(unshearnet.init, static_argnums=0, compiler_options=get_compile_options())

KEY = jax.random.key(0)
NET = UnshearNet(size=32, widths=(6, 8, 8), pose_channels=4, shear_channels=3)
ENTANGLED = UnshearNet(size=32, widths=(6, 8, 8), disentangled=False)
APART = replace(NET, separate_encoders=True)


@pytest.fixture(scope="module")
def variables():
    return quick_init(NET, KEY)


@pytest.fixture(scope="module")
def apart():
    return quick_init(APART, KEY)


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
    released = drop_parts(variables, "shear", "DS")
    with pytest.warns(Note, match="no shear code, as released ones do: z_p alone is given"):
        z_p, z_s = unshearnet.encode(NET, released, images)
    assert z_s is None
    codes = unshearnet.encode(NET, variables, images)
    np.testing.assert_array_equal(z_p, codes[0])
    with pytest.raises(UserError, match="no DS"):
        unshearnet.decode_sheared(NET, released, *codes)
    found, expected = (unshearnet.unshear(NET, each, images) for each in (released, variables))
    np.testing.assert_array_equal(found, expected)


def test_the_paper_at_256_px_has_codes_of_8_by_8():
    net = UnshearNet(size=256, widths=(32, 64, 64, 64, 64), pose_channels=64, shear_channels=64)
    variables = jax.eval_shape(lambda key: unshearnet.init(net, key), jax.random.key(0))
    images = jax.ShapeDtypeStruct((2, 256, 256, 1), jnp.float32)
    z_p, z_s = jax.eval_shape(lambda v, x: unshearnet.encode(net, v, x), variables, images)
    assert z_p.shape == z_s.shape == (2, 8, 8, 64)
    again = jax.eval_shape(lambda v, *z: unshearnet.decode_sheared(net, v, *z), variables, z_p, z_s)
    assert again.shape == images.shape


def test_entangled_has_one_code_and_one_decoder(images):
    variables = quick_init(ENTANGLED, KEY)
    assert set(variables["params"]) == {"E", "DC"}
    z, nothing = jax.eval_shape(partial(unshearnet.encode, ENTANGLED), variables, images)
    found, _ = jax.eval_shape(partial(unshearnet.reconstruct, ENTANGLED), variables, images)
    assert z.shape == found.z_p.shape == (5, 4, 4, 8)
    assert found.canonical.shape == images.shape
    assert nothing is found.sheared is found.z_s is None


def test_canonical_image_has_exactly_no_gradient_toward_the_shear_code(variables, images):
    def trained(given):
        return unshearnet.reconstruct(NET, given, images, KEY)[0].canonical ** 2

    def used(given):
        z_p, _ = unshearnet.encode(NET, given, images)
        return unshearnet.decode_canonical(NET, given, z_p) ** 2

    for draw in (trained, used):
        assert find_taught_parts(draw, variables) == {"E", "pose", "DC"}


def test_one_sum_gives_each_module_the_gradient_of_the_papers_own_loss(variables, images):
    """DC: the supervised and the patch term; DS: the reconstruction. Paper section 3.3."""
    target = jnp.roll(images, 2, 1)
    corners = distances.sample_corners(jax.random.key(2), 5, 10, 32, 8)
    coverage = distances.count_crop_coverage(corners, 32, 8)

    def loss(params, reconstruction, canonicals):
        found, _ = unshearnet.reconstruct(NET, variables | {"params": params}, images, KEY)
        canonical, sheared = jax.nn.sigmoid(found.canonical), jax.nn.sigmoid(found.sheared)
        rec = distances.compute_supervised_loss(sheared, images)
        sup = distances.compute_supervised_loss(canonical, target)
        patch = 0.1 * distances.compute_patch_loss(canonical, target, coverage)
        return reconstruction * jnp.mean(rec) + canonicals * (jnp.mean(sup) + jnp.mean(patch))

    gradient = jax.jit(jax.grad(loss))
    total = gradient(variables["params"], 1.0, 1.0)
    for modules, weights in ((("shear", "DS"), (1.0, 0.0)), (("DC",), (0.0, 1.0))):
        expected = gradient(variables["params"], *weights)
        for module in modules:
            for a, b in zip(*map(jax.tree.leaves, (total[module], expected[module])), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-6 * float(jnp.abs(b).max()) + 1e-12)


def test_inference_does_not_depend_on_the_batch(variables, images):
    unshear = jax.jit(partial(unshearnet.unshear, NET))
    alone = [unshear(variables, image[None])[0] for image in images]
    np.testing.assert_allclose(alone, unshear(variables, images), atol=1e-6)


def test_initial_weights_are_normal_with_deviation_002():
    params = quick_init(UnshearNet(), jax.random.key(3))["params"]
    leaves = jax.tree_util.tree_leaves_with_path(params)
    values = np.concatenate([np.ravel(x) for path, x in leaves if path[-1].key == "kernel"])
    assert abs(values.mean()) < 1e-4 and abs(values.std() - 0.02) < 1e-4


@pytest.mark.parametrize("wrong", [{"size": 100}, {"widths": (8,)}, {"widths": ()}])
def test_sizes_that_do_not_fit_are_refused_by_name(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        unshearnet.init(UnshearNet(**wrong), KEY)


def test_codes_that_are_apart_are_numbers_without_place(apart, images):
    assert set(apart["params"]) == {"E", "ES", "pose", "shear", "DC", "DS"}
    z_p, z_s = unshearnet.encode(APART, apart, images)
    assert (z_p.shape, z_s.shape) == ((5, 1, 1, 4), (5, 1, 1, 3))
    assert unshearnet.decode_sheared(APART, apart, z_p, z_s).shape == images.shape
    for scale in (1e3, 1e6):  # however large the layer's weights have grown
        large = jax.tree.map(lambda leaf, by=scale: by * leaf, apart["params"]["pose"])
        grown = apart | {"params": apart["params"] | {"pose": large}}
        numbers = unshearnet.encode(APART, grown, images)[0]
        np.testing.assert_allclose(numbers.mean(-1), 0, atol=1e-5)
        np.testing.assert_allclose(numbers.var(-1), 1, atol=0.02)
    canonical = jax.nn.sigmoid(unshearnet.decode_canonical(APART, apart, z_p))
    np.testing.assert_allclose(unshearnet.unshear(APART, apart, images), canonical, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "modules"),
    [
        ("canonical", {"E", "pose", "DC"}),
        ("sheared", {"DS"}),
        ("counterfactual", {"DS"}),
        ("disagreement", {"E", "pose"}),
        ("same_pose", {"E", "pose", "DC"}),
        ("z_s", {"ES", "shear"}),
    ],
)
def test_of_codes_that_are_apart_each_term_teaches_its_own_module(apart, images, name, modules):
    partners = jnp.roll(images, 3, 1), jnp.roll(images, 5, 2)

    def term(given):
        found, _ = unshearnet.reconstruct(APART, given, images, KEY, *partners)
        return getattr(found, name) ** 2

    assert find_taught_parts(term, apart) == modules


def test_partners_of_codes_that_are_apart(apart, images):
    """A contact that is its own partner agrees with itself; without partners nothing is exchanged, and the decoders draw the same."""
    itself, _ = unshearnet.reconstruct(APART, apart, images, KEY, images, images)
    np.testing.assert_allclose(itself.disagreement, 0, atol=1e-9)
    np.testing.assert_allclose(itself.counterfactual, itself.sheared, atol=1e-5)
    np.testing.assert_allclose(itself.same_pose, itself.canonical, atol=1e-5)
    alone, statistics = unshearnet.reconstruct(APART, apart, images, KEY)
    assert alone.counterfactual is alone.disagreement is alone.same_pose is None
    for name in ("canonical", "sheared", "z_p", "z_s"):
        np.testing.assert_allclose(getattr(alone, name), getattr(itself, name), atol=1e-5)
    assert jax.tree.structure(statistics) == jax.tree.structure(apart["batch_stats"])
    network = unshearnet.Network(APART)
    codes, _ = network.apply(apart, images, True, method="encode", mutable=["batch_stats"])
    for z, expected in zip((alone.z_p, alone.z_s), codes, strict=True):
        np.testing.assert_allclose(z, expected, atol=1e-6)


def test_a_wrong_image_size_is_refused(variables):
    with pytest.raises((TypeError, ValueError)):
        unshearnet.unshear(NET, variables, jnp.zeros((1, 30, 30, 1)))
