// Decide without Python: control_loop policy.pt2 <sensors> <motors> <state>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>

#include <torch/csrc/inductor/aoti_package/model_package_loader.h>
#include <torch/torch.h>

int main(int count, char** words) {
  if (count != 5) {
    std::fprintf(stderr, "usage: control_loop policy.pt2 <sensors> <motors> <state>\n");
    return 2;
  }
  const long sensors = std::atol(words[2]), motors = std::atol(words[3]);
  c10::InferenceMode no_gradient;
  at::set_num_threads(1);
  torch::inductor::AOTIModelPackageLoader policy(words[1], "model", /*run_single_threaded=*/true);

  auto observed = torch::ones({1, sensors}, torch::kBool);
  auto previous_action = torch::zeros({1, motors});
  auto is_init = torch::ones({1, 1}, torch::kBool);
  auto mean = torch::zeros({1, std::atol(words[4])}), age = torch::zeros({1, 1}, torch::kInt64);
  const int steps = 10000;
  const auto begin = std::chrono::steady_clock::now();
  for (int step = 0; step < steps; ++step) {
    auto observation = torch::zeros({1, sensors});  // read your sensors here ...
    observation[0][step % sensors] = NAN;           // ... NaN for what did not arrive
    auto out = policy.run({observation, observed, previous_action, is_init, mean, age});
    // out[0] is the action within its limits: send it to your motors here.
    mean = out[1], age = out[2], previous_action = out[3];
    is_init.zero_();
    if (step == 0 || step == steps - 1)
      std::printf("step %d, first motor %.6f\n", step, out[0][0][0].item<float>());
  }
  const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - begin;
  std::printf("%.1f us a step\n", took.count() / steps);
}
