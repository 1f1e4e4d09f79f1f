"""Calls of libraries of images and cameras: kornia, OpenCV, librealsense."""

from __future__ import annotations

from tests.peers.calls import Call, Section, by, in_order, rows_of, same

KORNIA = Section(
    "kornia",
    "Images are (B, C, H, W) there; depth is (V, H, W) here, 0 = no reading, and a cloud has the readings alone.",
    (
        Call(
            "kornia.geometry.depth_to_3d(depth[:, None], K.float())",
            "F.deproject_depth(depth, K)[0]",
            "only pixels with a reading, view after view: (points, ptr, pixel_index)",
            by(
                lambda a: a.permute(0, 2, 3, 1).reshape(-1, 3)[a[:, 2].flatten() > 0],
                lambda b: b,
                1e-5,
            ),
        ),
        Call(
            "kornia.geometry.depth_to_3d(depth[:, None], K.float(), normalize_points=True)",
            "F.deproject_depth(F.range_to_depth(depth, K), K)[0]",
            "depth along the rays becomes z first",
            by(
                lambda a: a.permute(0, 2, 3, 1).reshape(-1, 3)[a[:, 2].flatten() > 0],
                lambda b: b,
                1e-5,
            ),
        ),
        Call(
            "kornia.geometry.unproject_meshgrid(24, 32, K, dtype=K.dtype)",
            "F.pixel_rays(K, (24, 32))",
            "x and y at z = 1",
            by(lambda a: a[..., :2], lambda b: b),
        ),
        Call(
            "kornia.filters.bilateral_blur(depth[:, None] + (depth[:, None] == 0), (5, 5), 0.01, (1.5, 1.5))",
            "F.bilateral_filter(depth + (depth == 0), reach=2, sigma_pixels=1.5, sigma_depth=0.01, max_jump=1.0)",
            "never across an edge (`max_jump`) nor from a hole; nothing beyond the image, where kornia mirrors it",
            by(lambda a: a[:, 0, 2:-2, 2:-2], lambda b: b[:, 2:-2, 2:-2], 1e-5),
        ),
        Call(
            "kornia.filters.median_blur(depth[:, None] + (depth[:, None] == 0), 3)",
            "F.median_filter(depth + (depth == 0))",
            "of the readings in the window; holes stay holes",
            by(lambda a: a[:, 0, 1:-1, 1:-1], lambda b: b[:, 1:-1, 1:-1], 0),
        ),
        Call(
            "kornia.geometry.project_points(points + 0.5, K[0].float())",
            "F.project_points(points + 0.5, intrinsics=K[:1])[0]",
            "depth beside the pixels; a point that is not in front has none (NaN)",
            same(1e-4),
        ),
        Call(
            "kornia.geometry.calibration.distort_points(xy, torch.eye(3, dtype=torch.float64), lens[0])",
            "F.distort_normalized(xy[None], lens)",
            "normalized coordinates (x / z, y / z); more lenses",
            same(1e-9),
        ),
        Call(
            "kornia.geometry.calibration.undistort_points(xy, torch.eye(3, dtype=torch.float64), lens[0], "
            "num_iters=50)",
            "F.undistort_normalized(xy[None], lens)",
            "iterated until it is exact to 1e-12",
            same(1e-6),
        ),
        Call(
            "kornia.geometry.calibration.undistort_image(depth[:, None].double(), K, lens.expand(2, 5))",
            "F.undistort_image(depth[..., None], K, lens.expand(2, 5))",
            "(V, H, W, C), and a mask of what the camera saw; depth by `F.undistort_depth`, never blended at edges",
        ),
        Call(
            "kornia.geometry.depth.depth_to_normals(depth[:, None], K.float())",
            "F.depth_normals(depth, K)",
            "toward the camera; not across edges; curvature beside it",
        ),
        Call(
            "kornia.geometry.depth.depth_from_disparity(depth + 1, 0.05, 300.0)",
            "F.disparity_to_depth(32 * (depth + 1), torch.tensor([300.0, 300.0], dtype=torch.float64), 0.05)",
            "disparity in 1/32 of a pixel, as librealsense has it; 0 stays 0, no reading",
            same(1e-5),
        ),
        Call(
            "kornia.geometry.transform_points(pose[None].float(), points[None])",
            "pcdata.PointCloud(points=points, frame_id='base').transformed(pose.repeat(1, 1, 1)).points",
            "in float64, rounded once",
            same(1e-5),
        ),
        Call(
            "kornia.geometry.conversions.quaternion_to_rotation_matrix(torch.tensor([[0.8, 0.0, 0.6, 0.0]]))",
            "pcdata.geometry.rotations.rotation_from_quaternion(torch.tensor([[0.8, 0.0, 0.6, 0.0]]))",
            "w first in both",
            same(),
        ),
        Call(
            "PinholeCamera.scale(0.5)",
            "frame.camera.resized((12, 16))",
            "centers of pixels are kept: cx becomes (cx + 0.5) / 2 - 0.5",
            runs=False,
        ),
        Call(
            "warp_frame_depth(image_src, depth_dst, src_trans_dst, camera_matrix)",
            "pcdata.render(cloud, frame.camera.view(0), frame.world_from_camera[:1])",
            "forward, with a z-buffer: `render` a cloud, a mesh or a volume",
            runs=False,
        ),
    ),
    {"kornia": "kornia"},
)

OPENCV = Section(
    "OpenCV",
    "Pixels, lenses and axes are OpenCV's; an extrinsic (`rvec`, `tvec`) is camera from world.",
    (
        Call(
            "cv2.projectPoints((points + 0.5).double().numpy(), np.zeros(3), np.zeros(3), K[0].numpy(), "
            "lens[0].numpy())[0]",
            "F.project_points(points + 0.5, intrinsics=K[:1], distortion=lens)[0]",
            "points of the camera's frame; depth beside the pixels",
            same(1e-4),
        ),
        Call(
            "cv2.undistortPointsIter(xy[:, None].numpy(), np.eye(3), lens[0].numpy(), np.eye(3), np.eye(3), "
            "(cv2.TERM_CRITERIA_COUNT, 100, 0.0))",
            "F.undistort_normalized(xy[None], lens)",
            "exact to 1e-12 without a number of iterations",
            same(1e-8),
        ),
        Call(
            "cv2.fisheye.distortPoints(xy[:, None].numpy(), np.eye(3), np.array([0.01, 0.02, -0.01, 0.001]))",
            "F.distort_normalized(xy[None], pcdata.Camera.pinhole(fx=1.0, fy=1.0, cx=0.0, cy=0.0, size=(2, 2), "
            "lens='fisheye', "
            "distortion=[0.01, 0.02, -0.01, 0.001]).distortion)",
            "the lens is told by its name",
            same(1e-9),
        ),
        Call(
            "cv2.undistort(depth[0].numpy(), K[0].numpy(), lens[0].numpy())",
            "F.undistort_image(depth[:1, ..., None], K[:1], lens)",
            "not rounded to 1/32 pixel, nor blended with black at the border; a mask of what the camera saw",
        ),
        Call(
            "cv2.rgbd.depthTo3d(depth, K)",
            "F.deproject_depth(depth, K)",
            "only pixels with a reading, no NaN",
            runs=False,
        ),
        Call(
            "cv2.rgbd.registerDepth(K, K_color, lens, color_from_depth, depth, size)",
            "F.register_depth(depth, K, K, torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), color_size=(24, 32))",
            "surfaces are kept whole, and what lies behind them is dropped",
            runs=False,
        ),
        Call(
            "cv2.rgbd.RgbdNormals_create(...).apply(points)",
            "F.depth_normals(depth, K)",
            "from the depth",
            runs=False,
        ),
        Call(
            "cv2.reprojectImageTo3D((depth[0] + 1).numpy(), np.array([[1, 0, 0, -float(K[0, 0, 2])], [0, 1, 0, "
            "-float(K[0, 1, 2])], [0, 0, 0, float(K[0, 0, 0])], [0, 0, 1 / 0.05, 0]]))",
            "F.deproject_depth(F.disparity_to_depth(32 * (depth[:1] + 1), K[:1, 0, 0], 0.05), K[:1])[0]",
            "focal length and baseline, not Q; disparity in 1/32 of a pixel",
            by(lambda a: a.reshape(-1, 3), lambda b: b, 1e-4),
        ),
        Call(
            "cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0]",
            "pcdata.geometry.rotations.rotation_from_quaternion(pcdata.geometry.rotations."
            "quaternion_from_rotation_vector(torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)))",
            "batches",
            same(1e-9),
        ),
        Call(
            "cv2.estimateAffine3D(points.numpy(), (2 * moved).numpy(), force_rotation=True)",
            "F.fit_paired_points(points, 2 * moved, with_scale=True)",
            "the matrix contains the scale",
            by(lambda a: [a[1]], lambda b: b.scale, 1e-4),
        ),
        Call(
            "cv2.rotate(depth[0].numpy(), cv2.ROTATE_90_COUNTERCLOCKWISE)",
            "pcdata.TurnDepth(quarter_turns=1)(frame).depth[0]",
            "intrinsics and pose follow",
            same(0),
        ),
        Call(
            "cv2.resize(depth[0].numpy(), (16, 12))",
            "F.resize_depth(depth, size=(12, 16))",
            "(height, width); depth is never blended across an edge",
        ),
        Call(
            "cv2.medianBlur((depth[0] + (depth[0] == 0)).numpy(), 5)",
            "F.median_filter(depth[:1] + (depth[:1] == 0), reach=2)",
            "any number of readings in a window; its border repeats the image",
            by(lambda a: a[2:-2, 2:-2], lambda b: b[0, 2:-2, 2:-2], 0),
        ),
        Call(
            "cv2.bilateralFilter(depth[0].numpy(), 5, 0.01, 1.5)",
            "F.bilateral_filter(depth, reach=2, sigma_pixels=1.5, sigma_depth=0.01)",
            "a square window, exact weights, nothing across edges or from holes",
        ),
        Call(
            "cv2.inpaint(image, mask, 3, cv2.INPAINT_NS)",
            "pcdata.InpaintDepth()(frame)",
            "filled pixels are marked (`Confidence.COMPLETED`), and only near readings",
            runs=False,
        ),
        Call(
            "[cv2.pointPolygonTest(np.float32([[0, 0], [0.1, 0], [0, 0.1]]), tuple(map(float, p[:2])), False) > 0 "
            "for p in points]",
            "F.polygon_mask(points[:, :2].contiguous(), polygon=[(0, 0), (0.1, 0), (0, 0.1)])",
            "points on an edge belong to one side",
            by(rows_of, rows_of),
        ),
        Call(
            "cv2.convexHull(points[:, :2].contiguous().numpy())",
            "points[F.convex_hull(points[:, :2])][:, :2]",
            "rows, counterclockwise",
            by(lambda a: in_order(a[:, 0]), in_order),
        ),
    ),
    {"cv2": "cv2"},
)

LIBREALSENSE = Section(
    "librealsense",
    "Filters take float32 metres, all views at once; what a filter remembers is passed in and out. An `rs2_extrinsics` "
    "keeps its rotation column by column.",
    (
        Call(
            "rs.decimation_filter(2)",
            "F.decimate_depth(depth, factor=2)",
            "the camera follows in the step `DecimateDepth`",
        ),
        Call(
            "rs.spatial_filter(0.5, 20, 2, 0)",
            "pcdata.SpatialFilterDepth(alpha=0.5, delta=20.0, iterations=2)(frame)",
            "in disparity, by itself",
        ),
        Call(
            "rs.temporal_filter(0.4, 20, 3)",
            "F.temporal_filter(depth, alpha=0.4, delta=20.0, persistence=3)",
            "returns its state; for recordings: `pcdata.io.TemporallyFilteredSource`",
        ),
        Call(
            "rs.hole_filling_filter(1)",
            "pcdata.FillHoles(rule='farthest')(frame)",
            "0, 1, 2 are left, farthest, nearest; marked as filled",
        ),
        Call(
            "rs.disparity_transform(True)", "F.depth_to_disparity(depth, K[:, 0, 0], 0.05)", "1/32 of a pixel, as there"
        ),
        Call("rs.threshold_filter(0.2, 2.0)", "pcdata.MaskDepth(near=0.2, far=2.0)(frame)", ""),
        Call(
            "rs.align(rs.stream.color)",
            "F.register_depth(depth, K, K, torch.eye(4, dtype=torch.float64).repeat(2, 1, 1), color_size=(24, 32))",
            "with color: `pcdata.register_to_color`",
        ),
        Call(
            "rs.pointcloud().calculate(depth)",
            "pcdata.Deproject()(frame)",
            "colors, labels and the viewpoint come along",
        ),
        Call(
            "rs.rs2_deproject_pixel_to_point(intrinsics, pixel, depth)",
            "F.deproject_depth(depth, K, distortion=lens.expand(2, 5))",
            "every pixel",
        ),
        Call(
            "rs.rs2_project_point_to_pixel(intrinsics, point)",
            "F.project_points(points + 0.5, intrinsics=K[:1], distortion=lens)",
            "every point",
        ),
        Call("rs.rotation_filter()", "pcdata.TurnDepth(quarter_turns=1)(frame)", "counterclockwise"),
        Call(
            "rs.units_transform()",
            "pcdata.DepthFrame.from_numpy(np.full((1, 24, 32), 500, np.uint16), frame.camera.view(0), "
            "metres_per_unit=0.001)",
            "depth is in metres from the start",
        ),
    ),
)
