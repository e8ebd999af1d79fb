// What a C++ node does with the interfaces: fill them, read their constants, name their types.
#include <gtest/gtest.h>

#include <string>

#include "avatar_interfaces/action/build_patient.hpp"
#include "avatar_interfaces/msg/contact_state.hpp"
#include "avatar_interfaces/srv/load_vademecum.hpp"
#include "rosidl_runtime_cpp/traits.hpp"
#include "rosidl_typesupport_cpp/message_type_support.hpp"

using avatar_interfaces::msg::ContactState;

TEST(Messages, HoldContactsAndStatuses) {
  ContactState state;
  state.status = ContactState::STATUS_SLIPPED;
  state.contacts.resize(2);
  state.contacts[1].force.z = 1.5;
  const ContactState copy = state;
  EXPECT_EQ(copy, state);
  EXPECT_NE(copy, ContactState());
}

TEST(Messages, HaveTheNamesOfTheirPackage) {
  EXPECT_EQ(std::string("avatar_interfaces/msg/ContactState"),
    rosidl_generator_traits::name<ContactState>());
  EXPECT_EQ(std::string("avatar_interfaces/srv/LoadVademecum"),
    rosidl_generator_traits::name<avatar_interfaces::srv::LoadVademecum>());
  EXPECT_TRUE(avatar_interfaces::action::BuildPatient::Goal().surface.empty());
}

TEST(Messages, HaveATypeSupport) {
  EXPECT_NE(nullptr,
    rosidl_typesupport_cpp::get_message_type_support_handle<ContactState>());
}
