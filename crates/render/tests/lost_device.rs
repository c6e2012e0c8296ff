//! A GPU that is lost in mid-run: an error, not a panic.

use burn::tensor::Device;
use gazesplat_render::{Error, Splats, render};

use crate::common::scenes::{Draw, random};
use crate::common::with_gpu;

fn lose() {
    // A device of its own on the default adapter: the one that the other tests share has to live.
    let (device, setup) = Device::wgpu_options().init_with_setup().expect("the adapter opens twice");
    let scene = random(3, Draw::default());
    let splats = Splats::from_cloud(&scene.cloud, &device).expect("it fits");
    render(&splats, &scene.camera, &scene.options).expect("the adapter is still there");
    setup.device.destroy();
    for _ in 0..2 {
        let error = render(&splats, &scene.camera, &scene.options).expect_err("the adapter is gone");
        assert!(matches!(error, Error::Device { .. }) && error.hint().is_some(), "{error}");
        println!("{error}");
    }
}

#[test]
fn a_lost_device_is_an_error() {
    with_gpu(lose);
}
