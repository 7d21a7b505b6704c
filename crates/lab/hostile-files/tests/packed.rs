//! Small files that unpack to large things which nobody asked for.

use flate2::Compression;
use flate2::write::{GzEncoder, ZlibEncoder};
use gs_scene::{Image, image_has_alpha, image_size, splat};
use hostile_files::held;
use std::fs;
use std::io::Write;

/// A PNG of 20 x 16 pixels with a colour profile of so many zeros.
fn with_profile(zeros: usize) -> Vec<u8> {
    let grey = Image { width: 20, height: 16, rgb: vec![0.5; 960], alpha: None };
    let mut png = grey.to_png();
    let mut packed = ZlibEncoder::new(Vec::new(), Compression::best());
    packed.write_all(&vec![0; zeros]).unwrap();
    let chunk = [&b"iCCPbomb\0\0"[..], &packed.finish().unwrap()].concat();
    let mut crc = flate2::Crc::new();
    crc.update(&chunk);
    let length = (chunk.len() - 4) as u32;
    // Behind the signature and the header.
    png.splice(33..33, [&length.to_be_bytes()[..], &chunk, &crc.sum().to_be_bytes()].concat());
    png
}

#[test]
fn a_packed_colour_profile_takes_no_memory() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let bytes = with_profile(200 << 20);
    assert!(bytes.len() < 300_000, "{}", bytes.len());
    fs::write(&path, &bytes).unwrap();
    let most = 48 << 20;
    let taken = held(|| assert_eq!(image_size(&path).unwrap(), (20, 16)));
    assert!(taken < most, "the size: {taken}");
    let taken = held(|| assert!(!image_has_alpha(&path).unwrap()));
    assert!(taken < most, "the channels: {taken}");
    let taken = held(|| assert_eq!(Image::read(&path).unwrap().rgb.len(), 960));
    assert!(taken < most, "the pixels: {taken}");
    // A profile as cameras write it is no fault.
    fs::write(&path, with_profile(3_000)).unwrap();
    assert_eq!(Image::read(&path).unwrap().rgb.len(), 960);
}

#[test]
fn packed_gaussians_are_counted_without_unpacking() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.spz");
    let (count, degree) = (2_000_000u32, 0);
    let mut packed = GzEncoder::new(Vec::new(), Compression::best());
    packed.write_all(&[&b"NGSP\x03\0\0\0"[..], &count.to_le_bytes(), &[degree, 12, 0, 0]].concat()).unwrap();
    packed.write_all(&vec![0; 20 * count as usize]).unwrap();
    fs::write(&path, packed.finish().unwrap()).unwrap();
    let taken = held(|| assert_eq!(splat::count(&path).unwrap(), u64::from(count)));
    assert!(taken < 1 << 20, "{taken}");
    let taken = held(|| assert_eq!(splat::bytes_as_ply(&path).unwrap(), 4 * 17 * u64::from(count)));
    assert!(taken < 1 << 20, "{taken}");
}
